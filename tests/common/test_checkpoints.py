"""Checkpoints in LeRobot's layout."""

from pathlib import Path

from lerobot_wmrl.common.checkpoints import (
    checkpoint_dir,
    link_latest,
    should_save_checkpoint,
    write_checkpoint,
)


def test_a_kill_before_the_link_is_repaired(tmp_path: Path) -> None:
    link_latest(tmp_path)
    for step in (1, 2):
        write_checkpoint(tmp_path, 2, step, lambda folder: folder.mkdir(parents=True))
    last = tmp_path / "checkpoints" / "last"
    for left in ("000001", None):
        last.unlink()
        if left:
            last.symlink_to(left)
        link_latest(tmp_path)
        assert last.resolve() == checkpoint_dir(tmp_path, 2, 2).resolve()


def test_checkpoints_are_named_and_due_as_lerobots() -> None:
    assert checkpoint_dir(Path("run"), 20_000, 500) == Path("run/checkpoints/000500")
    assert checkpoint_dir(Path("run"), 10**7, 500).name == "00000500"
    assert [step for step in range(1, 8) if should_save_checkpoint(step, 3, 7)] == [3, 6, 7]
