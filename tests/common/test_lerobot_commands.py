"""Commands of LeRobot that errors ask for can be typed as they are printed."""

import shlex
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.scripts.lerobot_edit_dataset import EditDatasetConfig

from lerobot_wmrl.common.hub import cached_repo
from lerobot_wmrl.common.lerobot_commands import edit_advice


@pytest.mark.parametrize(
    ("operation", "setting", "value"),
    [
        ("remove_feature", "feature_names", ["next.success", "observation.depth"]),
        ("delete_episodes", "episode_indices", [3]),
    ],
)
def test_advice_to_edit_a_dataset_is_a_whole_command(operation: str, setting: str, value: list[Any]) -> None:
    program, *flags = shlex.split(edit_advice("data/my set", operation, {f"operation.{setting}": value}))
    config = draccus.parse(EditDatasetConfig, args=flags)
    assert program == "lerobot-edit-dataset"
    assert (config.repo_id, str(config.root)) == ("local/my set", "data/my set")
    assert Path(config.new_root) == Path("data/my set_edited")
    assert getattr(config.operation, setting) == value


def test_a_copy_of_a_dataset_in_the_hubs_cache_is_not_made_there(tmp_path: Path) -> None:
    """It would be taken for a revision, and lost when the cache is cleaned."""
    revision = tmp_path / "datasets--me--my_set" / "snapshots" / "0123abc"
    _, *flags = shlex.split(edit_advice(revision, "remove_feature", {"operation.feature_names": ["x"]}))
    config = draccus.parse(EditDatasetConfig, args=flags)
    assert (str(config.root), config.repo_id) == (str(revision), "local/my_set")
    assert Path(config.new_root) == Path("data/my_set_edited")


def test_a_folder_of_ones_own_is_not_taken_for_the_hubs_cache(tmp_path: Path) -> None:
    assert cached_repo(tmp_path / "models--me--mine" / "snapshots" / "0123abc") == "models--me--mine"
    assert cached_repo(tmp_path / "data" / "snapshots" / "run1") is None
