"""Runs another console command of this environment, as a user would type it."""

import logging
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from lerobot_wmrl.common import die_with_parent

TORCHRUN: Final = (
    "RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "GROUP_RANK", "GROUP_WORLD_SIZE", "ROLE_RANK",
    "ROLE_WORLD_SIZE", "ROLE_NAME", "MASTER_ADDR", "MASTER_PORT",
)  # fmt: skip
TORCHRUN_PREFIX: Final = "TORCHELASTIC_"
"""What torchrun tells its processes: a command with these would wait for the others, who do not run it."""


def run_subcommand(command: Sequence[str]) -> None:
    """Run it to its end in one process, its output where this one's goes. ValueError if it fails."""
    logging.info("$ %s", shlex.join(command))
    become = [sys.executable, "-I", "-S", die_with_parent.__file__, str(os.getpid())]
    program = [find_program(command[0]), *command[1:]]
    status = subprocess.run([*become, *program], env=environment()).returncode
    if status != 0:
        raise ValueError(
            f"{shlex.join(command)}: exit status {status}, for the reason above; what it finished is kept: "
            "the same call as before goes on from there"
        )


def environment() -> dict[str, str]:
    """This process's, without what makes it one of several."""
    return {
        name: value
        for name, value in os.environ.items()
        if name not in TORCHRUN and not name.startswith(TORCHRUN_PREFIX)
    }


def find_program(name: str) -> str:
    """The console command beside this interpreter, or on the path. ValueError if it is not installed."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.is_file() else shutil.which(name)
    if found is None:
        raise ValueError(f"the command {name} is not installed: run `make setup`")
    return found
