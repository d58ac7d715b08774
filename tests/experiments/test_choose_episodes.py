"""Which episodes of a recording a policy is cloned from."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from experiments.steps.choose_episodes import main, optimal_episodes, successes
from lerobot_wmrl.data.episodes import read_episodes
from tests.recorded import write_recording
from tests.relabelled import UNLABELLED, relabelled


def test_only_successful_optimal_episodes_are_taken(tmp_path: Path) -> None:
    root = tmp_path / "recording"
    write_recording(root)
    assert optimal_episodes(root, 2) == [0, 3]
    with pytest.raises(ValueError, match="holds 2 successful optimal episodes, 3 are needed"):
        optimal_episodes(root, 3)


def test_successes_are_the_first_or_all(small_dataset: LeRobotDataset) -> None:
    root, successful = Path(small_dataset.root), np.flatnonzero(read_episodes(small_dataset).success)
    assert successes(root, 1) == [successful[0]]
    assert successes(root, None) == successful.tolist()
    with pytest.raises(ValueError, match=f"{len(successful)} successes, 9 are needed"):
        successes(root, 9)


def test_a_dataset_without_labels_is_refused(
    small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = relabelled(Path(small_dataset.root), tmp_path / "unlabelled", UNLABELLED)
    monkeypatch.setattr("sys.argv", ["choose_episodes", str(silent), "--every_success"])
    with pytest.raises(SystemExit, match=r"error: .*has no column next\.success; record it with"):
        main()
