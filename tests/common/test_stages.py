"""The runner of the stages, on commands that take a moment: resuming, ending, refusing."""

import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from lerobot.configs import parser

from lerobot_wmrl.common import forks, stages
from lerobot_wmrl.common.errors import STOPPED, FieldError
from lerobot_wmrl.common.forks import entry_point, in_fork, run_measured, tree_memory
from lerobot_wmrl.common.lerobot_commands import edit_command, train_command
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.stages import Stage, StageError, read_record, run_stages
from lerobot_wmrl.demo.stages import Demo, DemoConfig
from lerobot_wmrl.improve.configuration_improve import ROLLOUT_SEED_OFFSET


def run_code() -> None:
    """What the test stages' command does: `python CODE`, in the process forked for it."""
    exec(sys.argv[1], {})


@pytest.fixture(autouse=True)
def commands_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code that takes a moment stands for commands; it needs no preloaded library and no GPU."""
    monkeypatch.setattr(forks, "entry_point", lambda program: run_code)
    monkeypatch.setattr(forks.torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(stages, "preload", lambda modules, offline: None)


def python(name: str, code: str) -> Stage:
    return Stage(name, name, lambda: ["python", code])


def appending(name: str, file: Path) -> Stage:
    return python(name, f"open({str(file)!r}, 'a').write({name!r})")


def test_finished_stages_are_not_repeated_and_a_failed_one_is(tmp_path: Path) -> None:
    file, fails = tmp_path / "ran", python("b", "raise SystemExit(4)")
    with pytest.raises(StageError, match=r"exit status 4.*b\.log"):
        run_stages([appending("a", file), fails, appending("c", file)], tmp_path)
    assert file.read_text() == "a"
    run_stages([appending("a", file), appending("b", file), appending("c", file)], tmp_path)
    assert file.read_text() == "abc"


def test_after_an_optional_stage_that_fails_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also by a second call, whose later stages may build on there being nothing."""
    file, fails = tmp_path / "ran", replace(python("b", "raise SystemExit(4)"), optional=lambda status: True)
    stages = [appending("a", file), fails, appending("c", file)]
    run_stages(stages, tmp_path)
    assert file.read_text() == "ac"
    assert f"b: exit status 4. Its output is in {tmp_path / 'logs' / 'b.log'}; the others go on" in (
        capsys.readouterr().out
    )
    record = read_record(tmp_path, "b")
    assert record["failed"] == "no output"
    assert not record["finished"]
    run_stages(stages, tmp_path)
    assert "[2/3] b: failed, and the others went on" in capsys.readouterr().out
    assert file.read_text() == "ac"


def test_an_optional_stage_is_tried_again_before_others_build_on_its_failure(tmp_path: Path) -> None:
    file, fails = tmp_path / "ran", replace(python("b", "raise SystemExit(4)"), optional=lambda status: True)
    run_stages([fails], tmp_path)
    run_stages([replace(appending("b", file), optional=lambda status: True), appending("c", file)], tmp_path)
    assert file.read_text() == "bc"
    assert "failed" not in read_record(tmp_path, "b")


def test_a_stage_may_say_only_when_it_fails_that_it_is_optional(tmp_path: Path) -> None:
    """As one that leaves something to go on with, or not."""
    left, file = tmp_path / "left", tmp_path / "ran"
    fails = replace(python("a", "raise SystemExit(4)"), optional=lambda status: status == 4 and left.exists())
    with pytest.raises(StageError, match="exit status 4"):
        run_stages([fails, appending("b", file)], tmp_path)
    left.touch()
    run_stages([fails, appending("b", file)], tmp_path)
    assert file.read_text() == "b"


def test_a_stage_that_stops_by_a_rule_of_its_own_is_not_to_be_run_again(tmp_path: Path) -> None:
    stops = python("b", f"import sys; print('stopped: nothing was rewarded'); sys.exit({STOPPED})")
    with pytest.raises(StageError, match=r"^b: nothing was rewarded$"):
        run_stages([stops], tmp_path)


def test_an_optional_stage_that_was_killed_has_not_failed(tmp_path: Path) -> None:
    kill = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    with pytest.raises(StageError, match="exit status -9"):
        run_stages([replace(python("b", kill), optional=lambda status: True)], tmp_path)
    assert "failed" not in read_record(tmp_path, "b")


@pytest.mark.parametrize(
    ("left", "kept"),
    [
        ([], False),
        (["000100"], False),
        (["000100", "000200"], True),
        (["000100", "last"], True),
    ],
)
def test_what_an_interrupted_command_left_is_removed_unless_it_goes_on_from_there(
    left: list[str], kept: bool, tmp_path: Path
) -> None:
    """When the stage runs, not when its command is asked for. Only `last` is whole for certain, and what is
    older than the newest checkpoint."""
    folder = tmp_path / "trained"
    for name in ("", *left):
        (folder / "checkpoints" / name).mkdir(parents=True, exist_ok=True)
    assert ("--resume=true" in train_command(folder, {})) == kept
    assert edit_command(folder, "merge", {})
    assert folder.exists()
    seen = f"import pathlib; assert pathlib.Path({str(folder)!r}).exists() == {kept}"
    run_stages([replace(python("a", seen), fresh=folder)], tmp_path)


def test_time_of_interrupted_attempts_counts(tmp_path: Path) -> None:
    stage = python("slow", "import time; time.sleep(0.5)")
    with pytest.raises(StageError):
        run_stages([python("slow", "import time; time.sleep(0.5); raise SystemExit(1)")], tmp_path)
    run_stages([stage], tmp_path)
    record = json.loads((tmp_path / "stages" / "slow.json").read_text())
    assert record["finished"]
    assert record["seconds"] > 1.0


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


@pytest.mark.parametrize(
    "flags",
    [
        {"seed": -1},
        {"seed": 10},
        {"eval_episodes": 0},
        {"rollouts": 0},
        {"rollouts": 50_001},
        {"rollouts": 11, "demonstrations": 8},
    ],
)
def test_impossible_settings_are_named(flags: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(flags))}="):
        DemoConfig(**flags).validate()


def test_training_and_evaluation_seeds_are_disjoint(tmp_path: Path) -> None:
    """Whatever the demo's seed, at a distance that no stage's number of episodes bridges."""
    trained = set()
    for seed in range(10):
        for stage in Demo(DemoConfig(tmp_path, seed)).stages():
            if stage.name not in ("unseen", "imagined"):  # they need a dataset, and have the evaluation's
                seeds = [
                    int(flag.partition("=")[2]) for flag in stage.command() if flag.startswith("--seed=")
                ]
                trained.update(seeds)
    assert trained == {100_000 * seed for seed in range(10)}
    assert EVALUATION_SEED - max(trained) >= 2 * ROLLOUT_SEED_OFFSET


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
