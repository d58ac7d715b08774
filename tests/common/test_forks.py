"""Commands and functions in forks: what they say and take is kept, and they end with this process."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.configs import parser

from lerobot_wmrl.common import forks
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.forks import entry_point, in_fork, run_measured, tree_memory
from tests.forked import code_for_commands


@pytest.fixture(autouse=True)
def commands_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code that takes a moment stands for commands; it needs no GPU."""
    code_for_commands(monkeypatch)


def test_output_and_memory_are_kept(tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    code = "import time; block = bytearray(200_000_000); print('out'); time.sleep(1.5); print('end')"
    reports: list[tuple[float, int]] = []
    log = tmp_path / "log"
    assert run_measured(["python", code], log, lambda *report: reports.append(report)) == 0
    assert log.read_text().split() == ["out", "end"]
    assert b"out\nend\n" in capfdbinary.readouterr().out
    assert 200e6 < reports[-1][1] < 200e6 + tree_memory(os.getpid())
    assert reports[-1][0] > 1.5


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_a_stage_ends_when_the_demo_is_stopped(sign: signal.Signals, tmp_path: Path) -> None:
    """By Ctrl-C, which it hears of, and by kill -9, which it does not.

    Python drops an interrupt that comes while hooks of a fork or finalizers run, so neither does here.
    """
    pid_file, log = tmp_path / "pid", tmp_path / "log"
    stage = (
        "import os, time; from pathlib import Path; time.sleep(0.5); "
        f"Path({str(pid_file)!r}).write_text(str(os.getpid())); time.sleep(60)"
    )
    process = multiprocessing.get_context("fork").Process(target=run_and_wait, args=(stage, log))
    process.start()
    wait_until(lambda: pid_file.exists() and pid_file.read_text() != "")
    os.kill(process.pid or 0, sign)
    process.join(30)
    assert process.exitcode is not None
    wait_until(lambda: tree_memory(int(pid_file.read_text())) == 0)


def run_and_wait(code: str, log: Path) -> None:
    """Run a stage as the demo does, in a process that hears Ctrl-C: background jobs ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    run_measured(["python", code], log, lambda *_: None)


def wait_until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def test_a_stage_does_not_read_this_program_s_config_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot keeps what a `--config_path` file says of `policy.path`, and ranks it above `--resume`."""
    monkeypatch.setattr(parser, "_config_path_args", {"policy": "outputs/policy"})
    monkeypatch.setattr(parser, "_config_yaml_overrides", {"policy": ["--push_to_hub=true"]})
    code = (
        "from lerobot.configs import parser as p\n"
        "print(p.get_path_arg('policy'), p.get_yaml_overrides('policy'))"
    )
    log = tmp_path / "log"
    assert run_measured(["python", code], log, lambda *_: None) == 0
    assert log.read_text().split() == ["None", "[]"]
    assert parser.get_path_arg("policy") == "outputs/policy"


def test_with_cuda_a_stage_is_a_fresh_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot use CUDA in a fork of a process that has asked for it."""
    monkeypatch.setattr(forks.torch.cuda, "is_available", lambda: True)
    log = tmp_path / "log"
    code = "import os, sys; print('torch' in sys.modules, os.getsid(0) == os.getpid()); sys.exit(3)"
    assert run_measured(["python", "-c", code], log, lambda *_: None) == 3
    assert log.read_text().split() == ["False", "True"]


def fork_or_fail(field: str | None) -> int:
    if field is not None:
        raise FieldError(field, 3, "is odd", "give 4")
    return os.getpid()


def test_what_a_fork_of_the_command_looks_at_is_returned_or_raised() -> None:
    """Nothing of it stays in the process that stages are forked from."""
    assert in_fork(fork_or_fail, None) != os.getpid()
    with pytest.raises(FieldError, match=r"^seed=3: is odd; give 4$"):
        in_fork(fork_or_fail, "seed")


def test_a_command_that_is_not_installed_is_named() -> None:
    with pytest.raises(ValueError, match=r"lerobot-wmrl-nothing is not installed: install .*`make setup`"):
        entry_point("lerobot-wmrl-nothing")
