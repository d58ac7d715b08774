"""What is said of datasets that can be learnt from, but should not be."""

from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.data.checks import solved_from_the_start
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from tests.relabelled import relabelled


def test_labels_of_whole_episodes_are_told_from_those_of_frames(
    small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    assert solved_from_the_start(read_episodes(small_dataset)) is None
    root = Path(small_dataset.root)
    whole = relabelled(root, tmp_path / "whole", {"next.success": [True] * small_dataset.num_frames})
    warning = solved_from_the_start(read_episodes(open_dataset(whole)))
    assert warning is not None
    assert warning.startswith("success holds from the first frame on in 6 of 6 successful episodes")
    none = relabelled(root, tmp_path / "none", {"next.success": [False] * small_dataset.num_frames})
    assert solved_from_the_start(read_episodes(open_dataset(none))) is None
