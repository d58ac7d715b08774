"""Policies, pipelines and buffers for the point environment."""

from collections.abc import Callable

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.pipeline import Pipeline

ACTION_SCALE = 0.1
"""Metres a normalised action: the point environment's largest step."""


def point_policy(image_size: int = 0, hidden_size: int = 32, initial_std: float = 0.5) -> CnnPolicy:
    """An untrained policy for PointEnv, on its state or on its image."""
    inputs = {"observation.state": PolicyFeature(type=FeatureType.STATE, shape=(4,))}
    if image_size:
        image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, image_size, image_size))
        inputs = {"observation.images.third_view": image}
    config = CnnConfig(
        device="cpu",
        input_features=inputs,
        hidden_size=hidden_size,
        width=8,
        initial_std=initial_std,
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(3,))},
    )
    return CnnPolicy(config).eval()


@pytest.fixture
def make_policy() -> Callable[..., CnnPolicy]:
    torch.manual_seed(0)
    return point_policy


@pytest.fixture
def pipeline() -> Pipeline:
    return Pipeline(prepare=lambda observation: observation, to_action=lambda raw: raw * ACTION_SCALE)
