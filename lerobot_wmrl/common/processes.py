"""Processes that a command starts: other console commands, and what every fork or child has to do first.

This file is also a program, `processes.py PID PROGRAM …`: it becomes PROGRAM, which is killed with its
parent PID. (A `preexec_fn` would run between fork and exec, where a process with threads can
wait for ever for a lock that one of them held.) It therefore imports the standard library alone.
"""

import ctypes
import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

SET_PARENT_DEATH_SIGNAL: Final = 1
"""An option of prctl(2)."""

TORCHRUN: Final = (
    "RANK",
    "LOCAL_RANK",
    "WORLD_SIZE",
    "LOCAL_WORLD_SIZE",
    "GROUP_RANK",
    "GROUP_WORLD_SIZE",
    "ROLE_RANK",
    "ROLE_WORLD_SIZE",
    "ROLE_NAME",
    "MASTER_ADDR",
    "MASTER_PORT",
)
TORCHRUN_PREFIX: Final = "TORCHELASTIC_"
"""Variables of torchrun's processes: a command with these would wait for the others of its group."""


def run_subcommand(command: Sequence[str]) -> None:
    """Run a console command of this environment to its end, in one process, with this one's output.

    Raises:
        ValueError: it fails.
    """
    logging.info("$ %s", shlex.join(command))
    become = [sys.executable, "-I", "-S", __file__, str(os.getpid())]
    program = [find_program(command[0]), *command[1:]]
    status = subprocess.run([*become, *program], env=environment()).returncode
    if status != 0:
        raise ValueError(
            f"{shlex.join(command)}: exit status {status}, for the reason above; what it finished is kept: "
            "the same call as before goes on from there"
        )


def environment() -> dict[str, str]:
    """Return this process's environment without what makes it one of several."""
    return {
        name: value
        for name, value in os.environ.items()
        if name not in TORCHRUN and not name.startswith(TORCHRUN_PREFIX)
    }


def find_program(name: str) -> str:
    """Find the console command beside this interpreter, or on the path. ValueError if there is none."""
    beside = Path(sys.executable).with_name(name)
    program = str(beside) if beside.is_file() else shutil.which(name)
    if program is None:
        raise not_installed(name)
    return program


def not_installed(name: str) -> ValueError:
    """Return the error about a console command that no package installs."""
    return ValueError(
        f"the command {name} is not installed: install its package into this environment (in a checkout of "
        "lerobot_wmrl: `make setup`)"
    )


def die_with(parent: int) -> None:
    """Let this process be killed when `parent`, which started it, is (Linux).

    Otherwise the next call would meet a second writer. The signal outlives exec. The parent may have died
    before the signal was asked for.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def own_progress_lock() -> None:
    """Stop sharing tqdm's lock with the process that this one was forked from. Call it first in a fork.

    The lock is a semaphore that forks share and that no one releases when its holder is killed: one of about
    200 kills of a recording process left every other process waiting for it.
    """
    from tqdm import tqdm

    tqdm.set_lock(threading.RLock())


if __name__ == "__main__":
    die_with(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])
