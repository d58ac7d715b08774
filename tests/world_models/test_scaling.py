"""How far a world model's states reach."""

import numpy as np
import pytest
import torch

from lerobot_wmrl.world_models import modeling_world_model
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.scaling import REACH, STATE_MIN_STD, Scale
from tests.trained import action_config

ROWS, OPEN = 10_000, 95.0


def recorded(open_share: float) -> np.ndarray:
    """States whose first component, a gripper, is open in a share of the frames, else at 3. (rows, 8)"""
    states = np.random.default_rng(0).normal(0, 0.1, (ROWS, 8))
    states[:, 0] = np.where(np.arange(ROWS) < ROWS * open_share, OPEN, 3.0)
    return states


def scale_of(states: np.ndarray) -> Scale:
    return Scale.of(8, {"mean": states.mean(0), "std": states.std(0)}, STATE_MIN_STD)


def test_a_gripper_that_is_seldom_open_is_not_clipped_and_an_accident_is() -> None:
    """Open in one of fifty frames it is seven standard deviations from its mean, in one of a thousand 32."""
    seldom, accident = recorded(0.02), recorded(0.001)
    limit = scale_of(seldom).reach(seldom)
    assert limit[0] == pytest.approx((OPEN - seldom[:, 0].mean()) / seldom[:, 0].std(), rel=1e-4)
    assert 6 < limit[0] < 8
    assert (limit[1:] == REACH).all()
    assert (scale_of(accident).reach(accident) == REACH).all()
    seldom[5, 1], seldom[6] = np.inf, np.nan
    assert scale_of(recorded(0.02)).reach(seldom)[0] > 6
    assert (scale_of(seldom).reach(None) == REACH).all()


def test_a_world_model_learns_states_as_far_as_they_were_recorded(
    small_dataset, trained_models, monkeypatch
) -> None:
    states = recorded(0.02)
    monkeypatch.setattr(modeling_world_model, "read_vectors", lambda *_: states)
    statistics = {"mean": states.mean(0), "std": states.std(0)}
    stats = {**small_dataset.meta.stats, "observation.state": statistics}
    model = ActionWorldModelRewardModel(
        action_config(trained_models["frame_tokenizer"]), dataset_stats=stats, dataset_meta=small_dataset.meta
    )
    found = model.denormalize_state(model.normalize_state(torch.tensor(states[:1], dtype=torch.float32)))
    assert found[0, 0] == pytest.approx(OPEN, rel=1e-4)
    assert 6 < model.state_limit[0] < 8
