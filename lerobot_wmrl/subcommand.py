"""Runs another console command of this environment, as a user would type it."""

import ctypes
import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

SET_PARENT_DEATH_SIGNAL = 1
"""Of prctl(2)."""

LIBC = ctypes.CDLL(None)
"""Loaded here, for a process that has just been forked should do as little as possible."""


def run_subcommand(command: Sequence[str]) -> None:
    """Run it to its end, its output where this process's goes. ValueError if it fails."""
    logging.info("$ %s", shlex.join(command))
    program = [find_program(command[0]), *command[1:]]
    status = subprocess.run(program, preexec_fn=partial(die_with, os.getpid())).returncode
    if status != 0:
        raise ValueError(
            f"{shlex.join(command)}: exit status {status}, for the reason above; what it finished is kept: "
            "the same call as before goes on from there"
        )


def find_program(name: str) -> str:
    """The console command beside this interpreter, or on the path. ValueError if it is not installed."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.is_file() else shutil.which(name)
    if found is None:
        raise ValueError(f"the command {name} is not installed: run `make setup`")
    return found


def die_with(parent: int) -> None:
    """In a forked process: be killed when its parent is, else the next call meets two writers (Linux)."""
    LIBC.prctl(SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
