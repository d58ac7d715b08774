"""What a dataset says about its robot, and what is refused."""

import json
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.embodiment import (
    Embodiment,
    check_same_robot,
    component_names,
    observed_range,
    read_embodiment,
)

JOINTS = ["shoulder", "elbow", "gripper"]
FPS = 50


def record(
    root: Path, actions: np.ndarray, names: object = None, info: dict[str, list[float]] | None = None
) -> LeRobotDatasetMetadata:
    """Record one episode of these actions (T, 3), without pictures, with LeRobot's own functions."""
    action = {"dtype": "float32", "shape": (3,), "names": JOINTS if names is None else names}
    state = {"dtype": "float32", "shape": (2,), "names": {"motors": ["a", "b"]}}
    features = {"action": action | ({"info": info} if info else {}), "observation.state": state}
    dataset = LeRobotDataset.create("local/joints", FPS, features, root=root)
    for row in actions.astype(np.float32):
        dataset.add_frame({"action": row, "observation.state": np.zeros(2, np.float32), "task": "reach"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata("local/joints", root=root)


def degrees(frames: int = 400) -> np.ndarray:
    """Two joints that sweep their ranges, and a gripper that is opened in one frame alone."""
    sweep = np.linspace(0, 1, frames)
    actions = np.stack([-90 + 180 * sweep, 45 * sweep, np.zeros(frames)], 1)
    actions[7, 2] = 30
    return actions


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["x", "y"], ["x", "y"]),
        ({"motors": ["x", "y"]}, ["x", "y"]),
        ({"x": 0, "y": 1}, ["x", "y"]),
        (None, ["0", "1"]),
        (["x"], ["0", "1"]),
        ({"a": ["x"], "b": ["y"]}, ["x", "y"]),
    ],
)
def test_components_have_names(names: object, found: list[str]) -> None:
    assert component_names({"shape": (2,), "names": names}) == found


def test_names_range_and_rate_come_from_the_dataset(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    found = read_embodiment(record(tmp_path / "data", degrees()), Embodiment())
    assert (found.fps, found.action_names, found.state_names) == (FPS, JOINTS, ["a", "b"])
    assert found.action_low == pytest.approx([-90, 0, 0])
    assert found.action_high == pytest.approx([90, 45, 30])
    assert "shoulder -90 to 90" in caplog.text


@pytest.mark.parametrize(("rate", "whole"), [(50.0, True), (29.97, False)])
def test_a_rate_of_frames_is_a_whole_number(rate: float, whole: bool, tmp_path: Path) -> None:
    """LeRobot's converter of older datasets wrote 50.0, which no setting of whole frames can hold."""
    record(tmp_path / "data", degrees())
    path = tmp_path / "data" / "meta" / "info.json"
    path.write_text(path.read_text().replace('"fps": 50', f'"fps": {rate}'))
    by_lerobot = LeRobotDatasetMetadata("local/joints", root=tmp_path / "data")  # as lerobot-train reads it
    if whole:
        for meta in (open_dataset(tmp_path / "data").meta, by_lerobot):
            assert json.dumps(read_embodiment(meta, Embodiment()).fps) == "50"
    else:
        for read in (
            lambda: open_dataset(tmp_path / "data"),
            lambda: read_embodiment(by_lerobot, Embodiment()),
        ):
            with pytest.raises(FieldError, match=r"dataset.root=.*has 29\.97 frames a second"):
                read()


def test_a_wrong_range_in_a_dataset_is_not_said_to_be_a_setting(tmp_path: Path) -> None:
    info = {"low": [0.0, 0.0, 5.0], "high": [1.0, 1.0, 1.0]}
    meta = record(tmp_path / "data", degrees(), info=info)
    with pytest.raises(FieldError, match=rf"^action\.info\.low=.*{JOINTS[2]} would range from 5\.0 to 1\.0"):
        read_embodiment(meta, Embodiment())


@pytest.mark.parametrize(
    ("info", "wrong"),
    [
        ({"low": [0.0] * 3}, r"high=None"),
        ({"low": 0, "high": [1.0] * 3}, "low=0"),
        ({"low": [0.0] * 3, "high": [[1.0] * 3]}, "high="),
        ({"low": ["x", "y", "z"], "high": [1.0] * 3}, "low="),
    ],
)
def test_a_range_in_a_dataset_is_two_lists_of_numbers(info: Any, wrong: str, tmp_path: Path) -> None:
    meta = record(tmp_path / "data", degrees(10), info=info)
    with pytest.raises(
        FieldError, match=rf"^action\.info\.{wrong}.*must be a list of numbers.*meta/info\.json"
    ):
        read_embodiment(meta, Embodiment())


def test_episodes_that_are_left_out_do_not_widen_the_range(tmp_path: Path) -> None:
    dataset = LeRobotDataset("local/joints", root=record(tmp_path / "data", degrees()).root)
    resumed = LeRobotDataset.resume("local/joints", root=dataset.root)
    for row in (100 * degrees()).astype(np.float32):
        resumed.add_frame({"action": row, "observation.state": np.zeros(2, np.float32), "task": "reach"})
    resumed.save_episode()
    resumed.finalize()
    meta = LeRobotDatasetMetadata("local/joints", root=dataset.root)
    assert read_embodiment(meta, Embodiment()).action_high[0] == pytest.approx(9000)
    assert read_embodiment(meta, Embodiment(), [0]).action_high[0] == pytest.approx(90)


def test_one_wrong_value_does_not_widen_the_range(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    actions = degrees()
    actions[3, 0], actions[4, 1] = 1e6, -1e6
    low, high = observed_range(record(tmp_path / "data", actions))
    assert 90 <= high[0] < 110
    assert -10 < low[1] <= 0
    said = r"action shoulder: 1 of \d+ recorded values lie outside .* -90 to \d.* reach from -90 to 1e\+06"
    assert re.search(said, caplog.text)
    assert "write the range into meta/info.json" in caplog.text


def test_a_range_cannot_be_guessed_without_data(tmp_path: Path) -> None:
    meta = record(tmp_path / "data", degrees())
    for file in (tmp_path / "data" / "data").rglob("*.parquet"):
        file.unlink()
    with pytest.raises(FieldError, match=r"has no files of data here.*leave out `--dataset\.streaming`"):
        observed_range(meta)


def test_a_rare_action_stays_possible(tmp_path: Path) -> None:
    """A gripper with a noisy sensor that closes in fewer than one of a hundred frames."""
    actions = np.random.default_rng(0).normal(100, 0.2, (2000, 3)).astype(np.float32)
    actions[500:515, 2] = 2
    low, _ = observed_range(record(tmp_path / "data", actions))
    assert low[2] == 2
    assert low[0] > 98


def test_a_recorded_range_goes_before_a_guessed_one_and_a_given_one_before_both(tmp_path: Path) -> None:
    info = {"low": [-180.0] * 3, "high": [180.0] * 3}
    meta = record(tmp_path / "data", degrees(), info=info)
    assert read_embodiment(meta, Embodiment()).action_high == [180.0] * 3
    given = Embodiment(action_low=[-1.0] * 3, action_high=[1.0] * 3)
    assert read_embodiment(meta, given).action_high == [1.0] * 3


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0.0], [1.0], "action has 3 components: shoulder, elbow, gripper"),
        ([0.0] * 3, [], "without the other end"),
        ([0.0, 2.0, 0.0], [1.0] * 3, r"elbow would range from 2\.0 to 1\.0"),
        ([0.0, np.nan, 0.0], [1.0] * 3, "elbow would range from nan"),
    ],
)
def test_a_range_that_is_none_is_refused(
    low: list[float], high: list[float], message: str, tmp_path: Path
) -> None:
    meta = record(tmp_path / "data", degrees(10))
    with pytest.raises(ValueError, match=message):
        read_embodiment(meta, Embodiment(action_low=low, action_high=high))


def test_a_dataset_of_another_robot_is_refused(tmp_path: Path) -> None:
    meta = record(tmp_path / "data", degrees(10))
    own = read_embodiment(meta, Embodiment())
    check_same_robot(own, meta)
    unnamed = record(tmp_path / "unnamed", degrees(10), names=["0", "1", "2"])
    check_same_robot(own, unnamed)
    with pytest.raises(ValueError, match="0, 1, 2, the world model has learnt x, y"):
        check_same_robot(Embodiment(action_names=["x", "y"]), unnamed)
    numbered = record(tmp_path / "numbered", degrees(10), names=["1_x", "2_y", "3_z"])
    with pytest.raises(ValueError, match="1_x, 2_y, 3_z, the world model has learnt shoulder"):
        check_same_robot(own, numbered)
    other = record(tmp_path / "other", degrees(10), names=["dx", "dy", "dz"])
    with pytest.raises(ValueError, match="dx, dy, dz, the world model has learnt shoulder, elbow, gripper"):
        check_same_robot(own, other)
    with pytest.raises(ValueError, match="has 50 frames a second, the world model has learnt 30"):
        check_same_robot(Embodiment(fps=30), meta)
