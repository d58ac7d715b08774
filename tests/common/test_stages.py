"""The runner of the stages, on commands that take a moment: resuming, ending, refusing."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_wmrl.common import stages
from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.lerobot_commands import edit_command, train_command
from lerobot_wmrl.common.stages import Stage, StageError, read_record, run_stages
from tests.forked import code_for_commands


@pytest.fixture(autouse=True)
def commands_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code that takes a moment stands for commands; it needs no preloaded library and no GPU."""
    code_for_commands(monkeypatch)
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
