"""How often a step of the imagination waits for the device."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lerobot_wmrl.rewards.configuration_rewards import EmbeddingConfig, GeneralConfig, ProxyConfig
from lerobot_wmrl.rewards.modeling_rewards import EmbeddingRewardModel, ProxyRewardModel
from tests.envs.imagination import B, always_done
from tests.read_backs import fetched
from tests.trained import action_config, run_training


def fetched_by_steps(env, steps: int) -> list[int]:
    """What the device is asked in each step of episodes that do not end."""
    always_done(env, torch.zeros(B, dtype=torch.bool))
    env.reset(seed=0)
    action = torch.zeros(B, 7)
    return [fetched(lambda: env.step(action)) for _ in range(steps)]


REWARDS = {
    "tokenizer": GeneralConfig(device="cpu"),
    "mse": GeneralConfig(device="cpu", similarity="mse"),
    "sparse": GeneralConfig(device="cpu", alpha=1.0),
}


@pytest.mark.parametrize("reward", list(REWARDS))
def test_a_step_asks_the_device_only_whether_an_episode_has_ended(config, reward):
    """Anchored dynamics ask once more in the first step, who begins."""
    env = replace(config, reward=REWARDS[reward]).create_tensor_env(B)
    assert fetched_by_steps(env, 4) == [2, 1, 1, 1]


def test_learned_rewards_ask_nothing_more(env):
    width, cameras = env.model.config.dynamics.width, env.model.config.tokenizer.cameras
    for reward in (
        ProxyRewardModel(ProxyConfig(device="cpu", cameras=cameras, image_size=32)),
        EmbeddingRewardModel(EmbeddingConfig(device="cpu", world_model="untrained", hidden_size=width)),
    ):
        env.reward = reward.eval()
        assert fetched_by_steps(env, 4) == [2, 1, 1, 1]


def test_autoregressive_dynamics_never_ask_who_begins(config, small_dataset, trained_models, tmp_path):
    model = action_config(trained_models["frame_tokenizer"], dynamics="autoregressive")
    output = run_training(model, Path(small_dataset.root), tmp_path / "model", steps=1)
    env = replace(config, world_model_path=str(output)).create_tensor_env(B)
    assert fetched_by_steps(env, 4) == [1] * 4


def test_anchored_dynamics_ask_who_begins_only_where_somebody_may(config):
    """Whenever a clip is full, and after the restart of somebody: that once, and when that clip is full."""
    env = replace(config, episode_length=50).create_tensor_env(B)
    clip, still = env.model.config.clip_length, torch.zeros(B, 7)
    quiet = [1] * (clip - 1)
    assert fetched_by_steps(env, 2 * clip + 1) == [2, *quiet, 2, *quiet, 2]
    step = env.model.step
    always_done(env, torch.tensor([True, False, False, False]))
    for _ in range(3):
        env.step(still)
    env.model.step = step
    assert env._elapsed.tolist() == [0] + [2 * clip + 4] * 3
    asked = [fetched(lambda: env.step(still)) for _ in range(clip + 1)]
    assert asked == [2 if row in (0, clip - 4, clip) else 1 for row in range(clip + 1)]
