"""A dataset's own statistics apply, by OpenVLA's definition, in LeRobot's processors."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION

from lerobot_policy_openvla.actions import (
    action_statistics,
    adopt_statistics,
    choose_key,
    dataset_statistics,
    lerobot_statistics,
)
from lerobot_policy_openvla.processor_openvla import make_openvla_pre_post_processors
from tests.lerobot_policy_openvla.small import CAMERA, small_config


@pytest.fixture
def meta(small_dataset: LeRobotDataset) -> LeRobotDatasetMetadata:
    """Its own, since it is changed."""
    return LeRobotDatasetMetadata(small_dataset.repo_id, root=small_dataset.root)


def all_actions(dataset: LeRobotDataset) -> np.ndarray:
    return np.stack(dataset.hf_dataset.with_format("numpy")[ACTION])


def test_quantiles_are_those_of_all_actions(
    meta: LeRobotDatasetMetadata, small_dataset: LeRobotDataset
) -> None:
    """LeRobot's are means over the episodes, which differ."""
    statistics = dataset_statistics(meta)
    assert statistics is not None
    actions = all_actions(small_dataset)
    for name, share in (("q01", 0.01), ("q99", 0.99)):
        assert np.allclose(statistics["action"][name], np.quantile(actions, share, axis=0), atol=1e-7)
    assert not np.allclose(statistics["action"]["q99"], meta.stats[ACTION]["q99"], atol=1e-4)
    assert statistics["action"]["mask"] == [True] * 6 + [False]
    assert (statistics["num_transitions"], statistics["num_trajectories"]) == (len(actions), 6)


def test_a_gripper_that_leaves_its_range_is_normalised() -> None:
    names = ["x", "left_Gripper", "gripper_width"]
    actions = np.array([[0.5, -1.0, 0.0], [0.1, 1.0, 80.0]])
    assert action_statistics(actions, names)["mask"] == [True, False, True]


def test_the_processors_normalise_by_the_datasets_own_statistics(
    meta: LeRobotDatasetMetadata, small_dataset: LeRobotDataset
) -> None:
    """LeRobot hands `meta.stats` to the processors, also to those of another dataset's checkpoint."""
    config = small_config()
    adopt_statistics(config, meta)
    assert config.unnorm_key == small_dataset.repo_id
    entry = config.norm_stats[small_dataset.repo_id]["action"]
    actions = torch.from_numpy(all_actions(small_dataset))
    for made_of in ((config, None), (small_config(), meta.stats)):
        preprocess, _ = make_openvla_pre_post_processors(*made_of)
        batch = {CAMERA: torch.zeros(len(actions), 3, 4, 4), ACTION: actions.clone()}
        normalised = preprocess({**batch, "task": [""] * len(actions)})[ACTION]
        low, high = (torch.tensor(entry[name]) for name in ("q01", "q99"))
        moved = high > low
        moved[6] = False
        expected = 2 * (actions - low) / (high - low) - 1
        assert torch.allclose(normalised[:, moved], expected[:, moved], atol=1e-5)
        assert torch.equal(normalised[:, 6], actions[:, 6])


def test_outside_the_mask_nothing_changes() -> None:
    action = {"q01": [0.0, 0.2], "q99": [4.0, 0.4], "mask": [True, False]}
    found = lerobot_statistics(action)
    assert found["q01"].tolist() == [0.0, -1.0]
    assert found["q99"].tolist() == [4.0, 1.0]
    assert lerobot_statistics({"q01": [0.0], "q99": [1.0]})["q99"].tolist() == [1.0]


def test_without_the_datas_files_lerobots_quantiles_serve(meta: LeRobotDatasetMetadata) -> None:
    """As when a dataset is streamed."""
    streamed = SimpleNamespace(root=Path("nowhere"), repo_id="user/far", stats=dict(meta.stats))
    config = small_config()
    adopt_statistics(config, streamed)
    assert config.norm_stats["user/far"]["action"]["q99"] == meta.stats[ACTION]["q99"].tolist()


def test_keys_are_chosen_as_the_original_chooses_them() -> None:
    assert choose_key({"bridge": 0}, None) == "bridge"
    assert choose_key({"bridge": 0, "fractal": 0}, None) is None
    assert choose_key({"bridge": 0, "fractal": 0}, "fractal") == "fractal"
    with pytest.raises(ValueError, match=r"unnorm_key=nope: .* choose one of bridge, fractal"):
        choose_key({"fractal": 0, "bridge": 0}, "nope")
