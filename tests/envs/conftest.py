"""An environment of tiny trained world models."""

from pathlib import Path

import pytest

from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from tests.envs.imagination import B


@pytest.fixture(scope="module")
def config(small_dataset, trained_models) -> WorldModelEnv:
    return WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        text_world_model_path=str(trained_models["text_world_model"]),
        dataset=StartFrames(root=str(Path(small_dataset.root))),
        episode_length=5,
        done_threshold=0.999,
    )


@pytest.fixture
def env(config):
    return config.create_tensor_env(B)
