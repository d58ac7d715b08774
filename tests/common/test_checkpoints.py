"""Checkpoints in LeRobot's layout."""

import json
import shutil
from pathlib import Path

import pytest

from lerobot_wmrl.common.checkpoints import (
    checkpoint_digest,
    checkpoint_dir,
    link_latest,
    may_be_on_hub,
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


def test_a_digest_changes_with_whatever_a_model_is_loaded_from(tmp_path: Path) -> None:
    base, planner = tmp_path / "base", tmp_path / "planner"
    for folder, settings in ((base, {}), (planner, {"world_model_path": str(base)})):
        folder.mkdir()
        (folder / "config.json").write_text(json.dumps(settings))
        (folder / "model.safetensors").write_bytes(b"weights")
    first, planned = checkpoint_digest(base), checkpoint_digest(planner)
    (base / "train_config.json").write_text("{}")
    shutil.copytree(base, tmp_path / "copy")
    assert checkpoint_digest(tmp_path / "copy") == checkpoint_digest(base) == first
    (base / "model.safetensors").write_bytes(b"others")
    assert checkpoint_digest(base) != first
    assert checkpoint_digest(planner) != planned


def test_checkpoints_are_named_and_due_as_lerobots() -> None:
    assert checkpoint_dir(Path("run"), 20_000, 500) == Path("run/checkpoints/000500")
    assert checkpoint_dir(Path("run"), 10**7, 500).name == "00000500"
    assert [step for step in range(1, 8) if should_save_checkpoint(step, 3, 7)] == [3, 6, 7]


@pytest.mark.parametrize(
    ("name", "on_hub"),
    [
        ("user/model", True),
        ("outputs-lab/model", True),
        ("gpt2", True),
        ("outputs/model", False),
        ("runs/a/model", False),
        ("./model", False),
        ("/models/a", False),
        ("../model", False),
    ],
)
def test_names_of_the_hub_have_one_owner_and_are_not_where_commands_write(name: str, on_hub: bool) -> None:
    assert may_be_on_hub(name) == on_hub
