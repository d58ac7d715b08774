"""Checkpoints in LeRobot's layout."""

from pathlib import Path

from lerobot_wmrl.common.checkpoints import checkpoint_dir, should_save_checkpoint


def test_checkpoints_are_named_and_due_as_lerobots() -> None:
    assert checkpoint_dir(Path("run"), 20_000, 500) == Path("run/checkpoints/000500")
    assert checkpoint_dir(Path("run"), 10**7, 500).name == "00000500"
    assert [step for step in range(1, 8) if should_save_checkpoint(step, 3, 7)] == [3, 6, 7]
