"""What is read from a dataset beside its pictures."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.data.episodes import open_dataset, read_episodes

FEATURES = {"action": {"dtype": "float32", "shape": (1,), "names": ["x"]}}


def record(root: Path, episodes: list[list[str]]) -> Path:
    """Record episodes with an instruction for each frame, with LeRobot's own functions."""
    dataset = LeRobotDataset.create("local/tasks", 10, FEATURES, root=root)
    for instructions in episodes:
        for instruction in instructions:
            dataset.add_frame({"action": np.zeros(1, np.float32), "task": instruction})
        dataset.save_episode()
    dataset.finalize()
    return root


def test_the_instruction_of_an_episode_is_that_of_its_first_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    table = read_episodes(open_dataset(record(tmp_path / "one", [["open", "open"], ["close"]])))
    assert table.instructions == ["open", "close"]
    assert "the instruction changes" not in caplog.text
    several = record(tmp_path / "several", [["open", "open"], ["close", "open", "lift"]])
    assert read_episodes(open_dataset(several)).instructions == ["open", "close"]
    assert "the instruction changes within 1 of 2 episodes" in caplog.text
