"""Load an environment's reward: ours, or one of LeRobot's own reward models with its preprocessor."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.rewards.factory import make_reward_model, make_reward_pre_post_processors
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

from lerobot_wmrl.common.checkpoints import local_model_folder
from lerobot_wmrl.common.constants import INSTRUCTIONS
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.precision import device_setting
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig, LearnedRewardConfig
from lerobot_wmrl.rewards.general import potential_discount
from lerobot_wmrl.rewards.modeling_rewards import EmbeddingRewardModel, ProxyRewardModel
from lerobot_wmrl.world_models.checkpoint import load_model, read_config
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

PREPROCESSORS: Final = "*preprocessor.json"
"""Each type of reward model saves its preprocessor under a name of its own."""


class Reward(Protocol):
    """A reward as the environment calls it."""

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the reward of the frames in the environment's batch. → (B,)"""


def load_reward(config: RewardModelConfig, model: ActionWorldModelRewardModel, longest: int) -> Reward:
    """Return the reward of an environment that imagines up to `longest` steps of an episode with `model`.

    A reward with a checkpoint takes its settings from there.

    Raises:
        FieldError: the reward does not fit the world model, or has to be trained first.
    """
    device = device_setting(model.device)
    if isinstance(config, GeneralConfig):
        return make_reward_model(replace(config, gamma=potential_discount(config, longest)))
    if not isinstance(config, LearnedRewardConfig):
        return load_lerobot_reward(config, model.config.tokenizer.camera_keys, device)
    if not config.pretrained_path:
        raise FieldError(
            "reward.pretrained_path",
            config.pretrained_path,
            f"the {config.type} reward is learnt",
            f"train a reward model of type {config.type} with lerobot-train and give its output folder",
        )
    reward: EmbeddingRewardModel | ProxyRewardModel = load_model(config.pretrained_path, config.type, device)
    reward.check_world_model(model)
    return reward


class LeRobotReward:
    """One of LeRobot's reward models with its preprocessor, given the present frame and the instruction."""

    def __init__(self, reward: PreTrainedRewardModel, preprocessor: PolicyProcessorPipeline) -> None:
        self.reward, self.preprocessor = reward.eval(), preprocessor

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the reward of the environment's batch. → (B,)

        The reward is shown its input features alone.
        """
        known = {*(self.reward.config.input_features or batch), INSTRUCTIONS}
        device = batch["success"].device
        prepared = self.preprocessor({name: value for name, value in batch.items() if name in known})
        return self.reward.compute_reward(prepared).float().to(device)


def load_lerobot_reward(config: RewardModelConfig, cameras: list[str], device: str) -> LeRobotReward:
    """Return the reward with its checkpoint's settings and preprocessor, or new ones without a checkpoint.

    Raises:
        FieldError: the reward needs what an imagined episode does not have.
    """
    config.device = device
    if config.pretrained_path:
        path = config.pretrained_path
        config = read_config(path, config.type, device)
        config.pretrained_path = str(local_model_folder(path))
    check_observation(config, cameras)
    return LeRobotReward(make_reward_model(config), load_preprocessor(config))


def load_preprocessor(config: RewardModelConfig) -> PolicyProcessorPipeline:
    """Return the preprocessor in a reward's checkpoint, or a new one for a reward without a checkpoint.

    Raises:
        FieldError: the checkpoint has none, so that nobody knows how it normalises.
    """
    if not config.pretrained_path:
        return make_reward_pre_post_processors(config)[0]
    saved = sorted(Path(config.pretrained_path).glob(PREPROCESSORS))
    if not saved:
        raise FieldError(
            "reward.pretrained_path",
            config.pretrained_path,
            f"has no preprocessor ({PREPROCESSORS})",
            "give a checkpoint as lerobot-train writes it",
        )
    overrides = {"device_processor": {"device": config.device}}
    return PolicyProcessorPipeline.from_pretrained(
        saved[0].parent, config_filename=saved[0].name, overrides=overrides
    )


def check_observation(config: RewardModelConfig, cameras: list[str]) -> None:
    """Raise FieldError unless one frame of `cameras` (dataset keys) is all that the reward needs."""
    if any(config.observation_delta_indices or ()):
        raise FieldError(
            "reward.type",
            config.type,
            "looks at earlier or later frames than the one that it rewards",
            "choose another reward",
        )
    missing = [name for name in config.input_features if name.startswith(OBS_IMAGE) and name not in cameras]
    if missing:
        raise FieldError(
            "reward.type",
            config.type,
            f"looks at {', '.join(missing)}, the world model imagines {', '.join(cameras)}",
            "train the reward on these cameras",
        )
