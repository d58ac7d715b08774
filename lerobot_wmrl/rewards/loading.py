"""The reward of an environment, from its configuration or from a training's checkpoint."""

from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import make_reward_model
from lerobot.rewards.pretrained import PreTrainedRewardModel

from lerobot_wmrl.rewards.configuration_learned import LearnedRewardConfig
from lerobot_wmrl.rewards.modeling_learned import EmbeddingRewardModel
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


def load_reward(config: RewardModelConfig, model: ActionWorldModelRewardModel) -> PreTrainedRewardModel:
    """Where there is a checkpoint, its settings count. ValueError if the reward does not fit `model`."""
    device = model.state_mean.device.type
    if config.pretrained_path:
        reward: PreTrainedRewardModel = load_model(config.pretrained_path, config.type, device)
    elif isinstance(config, LearnedRewardConfig):
        raise ValueError(
            f"--env.reward.pretrained_path is missing: --env.reward.type={config.type} is learnt; train it "
            f"with lerobot-train --reward_model.type={config.type} and give its output folder"
        )
    else:
        reward = make_reward_model(config)
    if isinstance(reward, EmbeddingRewardModel):
        reward.check_world_model(model)
    return reward
