"""Code that takes a moment, in the place of a console command that is run in a fork."""

import sys

import pytest

from lerobot_wmrl.common import forks


def run_code() -> None:
    """What the command does: `python CODE`, in the process forked for it."""
    exec(sys.argv[1], {})


def code_for_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let code stand for commands; it needs no GPU."""
    monkeypatch.setattr(forks, "entry_point", lambda program: run_code)
    monkeypatch.setattr(forks.torch.cuda, "is_available", lambda: False)
