"""Configuration of GRPO, `algorithm.type` grpo."""

from dataclasses import dataclass
from typing import ClassVar

from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.common.errors import FieldError, require_at_least, require_positive, require_share
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig


@RLAlgorithmConfig.register_subclass("grpo")
@dataclass
class GRPOConfig(PolicyGradientConfig):
    """Group relative policy optimisation (Shao et al. 2024): episodes that start alike are compared with each
    other, so no value function is needed. Asymmetric clip and group filter as in DAPO (Yu et al. 2025).

    Args:
        group_size: environments that start from the same state; must divide `num_envs`.
        clip_low: how far the ratio may move below 1.
        clip_high: how far the ratio may move above 1.
        least_group_std: smallest standard deviation of a group's returns at which the group is trained on.
            With a reward of about 1 for success, groups below it have all succeeded or all failed.
        reference_coefficient: weight of the KL penalty towards the SFT policy; GRPO needs none.
    """

    compares_starts: ClassVar[bool] = True
    discounts: ClassVar[bool] = False

    group_size: int = 8
    clip_low: float = 0.2
    clip_high: float = 0.28
    least_group_std: float = 0.05
    reference_coefficient: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "clip_low", "clip_high", "least_group_std")
        require_share(self, "clip_low", "clip_high")
        require_at_least(self, 2, "group_size")

    def check(self, num_envs: int, iterations: int, env: EnvConfig) -> None:
        """Raise FieldError unless the environments can be divided into groups."""
        if num_envs % self.group_size:
            raise FieldError(
                "num_envs",
                num_envs,
                f"must be a multiple of `algorithm.group_size={self.group_size}`, the environments that "
                "start from the same state",
            )

    def discount(self, longest: int) -> float:
        """Return 1: the rewards of an episode are added up."""
        return 1.0
