"""The noise that leads a policy's episodes off their path."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import EpisodePlan
from lerobot_dataset_maniskill.worker import PolicyController
from lerobot_wmrl.common.constants import POLICY
from lerobot_wmrl.common.exploration import ExplorationNoise
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, TRANSLATION
from lerobot_wmrl.maniskill.episode import Frame
from tests.rl.checkpoints import save_untrained_policy

STEPS = 400


def walk(largest: float, seed: int) -> np.ndarray:
    noise = ExplorationNoise(largest, seed, TRANSLATION)
    return np.array([noise() for _ in range(STEPS)]) / ACTION_HIGH[:3]


def test_a_seed_gives_its_noise_again() -> None:
    assert np.array_equal(walk(0.4, 7), walk(0.4, 7))
    assert not np.array_equal(walk(0.4, 7), walk(0.4, 8))


def test_without_exploration_nothing_is_added() -> None:
    assert not walk(0.0, 3).any()


def test_episodes_have_their_own_level_below_the_largest() -> None:
    levels = np.array([walk(0.4, seed).std() for seed in range(60)])
    assert levels.max() < 0.4 * 1.4
    assert levels.min() < 0.08
    assert levels.max() > 0.25


def test_noise_lasts_about_ten_steps() -> None:
    path = np.concatenate([walk(0.4, seed) for seed in range(20)])
    along, later = path[:-1].ravel(), path[1:].ravel()
    assert 0.8 < np.corrcoef(along, later)[0, 1] < 0.97


@pytest.mark.parametrize(("constant", "share"), [(0.01, 0.0), (0.5, 6 / 7), (2.0, 1.0)])
def test_what_a_policy_does_out_of_range_is_counted_and_noise_is_not(
    constant: float, share: float, tmp_path: Path
) -> None:
    far = save_untrained_policy(tmp_path / "policy", size=8, actions=7, constant=constant)
    controller = PolicyController(read_policy_config(str(far), []), exploration=1.0)
    frame = Frame({"third_view": np.zeros((8, 8, 3), np.uint8)}, {}, np.zeros(8, np.float32), 0.0, False)
    simulation: Any = SimpleNamespace(instruction="push the cube")
    scene: Any = None  # the policy sees it in the frame alone
    for _ in range(2):
        controller.begin(simulation, EpisodePlan("push", POLICY, scene, 7))
        actions = np.stack([controller.act(simulation, frame) for _ in range(5)])
        assert controller.clipped == pytest.approx([share] * 5)
    assert (np.abs(actions) <= np.float32(ACTION_HIGH)).all()


@pytest.mark.parametrize("exploration", [-0.1, 1.5, 0.3])
def test_a_share_outside_the_box_or_without_a_policy_is_refused(exploration: float, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"exploration={exploration}: .*rollouts only; give `policy\.path`"):
        RecordConfig(output_dir=tmp_path, exploration=exploration).validate()
