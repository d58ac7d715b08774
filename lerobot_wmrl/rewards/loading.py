"""The reward of an environment, from its configuration or from a training's checkpoint."""

from typing import Any, Protocol

from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import make_reward_model
from torch import Tensor

from lerobot_wmrl.rewards.configuration_general import GeneralConfig
from lerobot_wmrl.rewards.configuration_learned import LearnedRewardConfig
from lerobot_wmrl.rewards.modeling_learned import EmbeddingRewardModel, ProxyRewardModel
from lerobot_wmrl.rewards.prepared import load_prepared
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


class Reward(Protocol):
    """What an environment asks."""

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Of frames as the environment describes them. → (B,)"""


def load_reward(config: RewardModelConfig, model: ActionWorldModelRewardModel) -> Reward:
    """Where there is a checkpoint, its settings count. ValueError if the reward does not fit `model`."""
    device = model.state_mean.device.type
    if isinstance(config, GeneralConfig):
        return make_reward_model(config)
    if not isinstance(config, LearnedRewardConfig):
        return load_prepared(config, model.config.camera_keys, device)
    if not config.pretrained_path:
        raise ValueError(
            f"--env.reward.pretrained_path is missing: --env.reward.type={config.type} is learnt; train it "
            f"with lerobot-train --reward_model.type={config.type} and give its output folder"
        )
    reward: EmbeddingRewardModel | ProxyRewardModel = load_model(config.pretrained_path, config.type, device)
    reward.check_world_model(model)
    return reward
