"""Commands that a command runs: each alone, none left behind, no Python between fork and exec."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from lerobot_wmrl.common import processes
from lerobot_wmrl.common.processes import run_subcommand

PATIENCE_S = 60


@pytest.fixture
def python(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a command that is this interpreter."""
    monkeypatch.setattr(processes, "find_program", lambda name: sys.executable)
    return "python"


def test_it_is_none_of_torchrun_s_processes(
    python: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that believed to be would wait for the others of its group."""
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "TORCHELASTIC_USE_AGENT_STORE", "OWN"):
        monkeypatch.setenv(name, "1")
    seen = tmp_path / "seen"
    run_subcommand([python, "-c", f"import os; open({str(seen)!r}, 'w').write(' '.join(os.environ))"])
    names = seen.read_text().split()
    assert "OWN" in names
    assert not [name for name in names if "RANK" in name or name.startswith(("WORLD", "MASTER", "TORCHEL"))]


def test_no_hook_of_a_fork_runs(python: str) -> None:
    """They, and all Python between fork and exec, may wait for a lock of a thread that the fork has not."""
    forks: list[str] = []
    os.register_at_fork(before=lambda: forks.append("fork"))
    run_subcommand([python, "-c", ""])
    assert not forks


def test_a_failure_is_an_error_with_its_exit_status(python: str) -> None:
    with pytest.raises(
        ValueError, match=r"^python -c 'raise SystemExit\(3\)': exit status 3, for the reason"
    ):
        run_subcommand([python, "-c", "raise SystemExit(3)"])


def test_a_command_that_is_not_installed_is_named() -> None:
    with pytest.raises(ValueError, match="the command lerobot-wmrl-dance is not installed"):
        run_subcommand(["lerobot-wmrl-dance"])


def test_it_is_killed_with_the_command_that_runs_it(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    inner = (
        "import os, time, pathlib; "
        f"pathlib.Path({str(pid_file)!r} + '.new').write_text(str(os.getpid())); "
        f"os.rename({str(pid_file)!r} + '.new', {str(pid_file)!r}); time.sleep({PATIENCE_S})"
    )
    outer = (
        "import sys; from importlib.util import module_from_spec, spec_from_file_location; "
        f"spec = spec_from_file_location('processes', {processes.__file__!r}); "
        "processes = module_from_spec(spec); spec.loader.exec_module(processes); "
        "processes.find_program = lambda name: sys.executable; "
        f"processes.run_subcommand(['python', '-c', {inner!r}])"
    )
    process = subprocess.Popen([sys.executable, "-c", outer])
    end = time.monotonic() + PATIENCE_S
    while not pid_file.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    child = psutil.Process(int(pid_file.read_text()))
    process.send_signal(signal.SIGKILL)
    process.wait(PATIENCE_S)
    _, alive = psutil.wait_procs([child], timeout=PATIENCE_S / 6)
    assert not alive
