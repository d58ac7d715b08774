"""The general reward behind LeRobot's reward-model interface."""

from typing import Any

from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor

from lerobot_wmrl.rewards.configuration_general import GeneralConfig
from lerobot_wmrl.rewards.general import general_reward


class GeneralRewardModel(PreTrainedRewardModel):
    """No weights of its own: it joins what the two world models say."""

    config_class = GeneralConfig
    name = "general"

    def __init__(self, config: GeneralConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: GeneralConfig = config

    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """Keys `success` (1 once, on the frame at which the k-frame done fires) and, unless α is 1,
        `similarity` and `previous.similarity`, each (B,). → (B,)"""
        if not self.config.needs_goal:
            return batch["success"]
        return general_reward(
            batch["success"], batch["similarity"], batch["previous.similarity"],
            alpha=self.config.alpha, form=self.config.form, gamma=self.config.gamma,
        )  # fmt: skip
