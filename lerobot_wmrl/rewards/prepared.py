"""LeRobot's own reward models, which want an observation as their processors prepare it."""

from typing import Any, Final

import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.rewards.factory import make_reward_model, make_reward_pre_post_processors
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

from lerobot_wmrl.common.checkpoints import resolve_checkpoint
from lerobot_wmrl.world_models.checkpoint import read_config

TASK: Final = "task"
PREPROCESSORS: Final = "*preprocessor.json"
"""Each type of reward model saves its own under a name of its own."""


class PreparedReward:
    """A reward model and its preprocessor; they are given the present frame and the instruction."""

    def __init__(self, reward: PreTrainedRewardModel, preprocessor: PolicyProcessorPipeline) -> None:
        self.reward, self.preprocessor = reward.eval(), preprocessor

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Of the environment's batch; names that the reward's configuration has no feature of are left out.
        → (B,)"""
        known = {*(self.reward.config.input_features or batch), TASK}
        device = batch["success"].device
        prepared = self.preprocessor({name: value for name, value in batch.items() if name in known})
        return self.reward.compute_reward(prepared).float().to(device)


def load_prepared(config: RewardModelConfig, cameras: list[str], device: str) -> PreparedReward:
    """With its checkpoint's settings and what is saved beside the weights, if it has a checkpoint.

    ValueError if it needs what an environment has not.
    """
    config.device, saved = device, []
    if config.pretrained_path:
        folder = resolve_checkpoint(config.pretrained_path)
        config, saved = read_config(folder, config.type, device), sorted(folder.glob(PREPROCESSORS))
        config.pretrained_path = str(folder)
    check_observation(config, cameras)
    if saved:
        overrides = {"device_processor": {"device": device}}
        preprocessor = PolicyProcessorPipeline.from_pretrained(
            saved[0].parent, config_filename=saved[0].name, overrides=overrides
        )
    else:
        preprocessor = make_reward_pre_post_processors(config)[0]
    return PreparedReward(make_reward_model(config), preprocessor)


def check_observation(config: RewardModelConfig, cameras: list[str]) -> None:
    """ValueError unless one frame of these `cameras`, as the dataset calls them, is enough."""
    if any(step > 0 for step in config.observation_delta_indices or ()):
        raise ValueError(
            f"--env.reward.type={config.type}: looks at frames of the future, which a policy that acts does "
            "not have; choose another reward"
        )
    missing = [name for name in config.input_features if name.startswith(OBS_IMAGE) and name not in cameras]
    if missing:
        raise ValueError(
            f"--env.reward.type={config.type}: looks at {', '.join(missing)}; the world model imagines "
            f"{', '.join(cameras)}"
        )
