"""Configuration of GRPO, `--algorithm.type=grpo`."""

from dataclasses import dataclass

from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.rl.configuration_policy_gradient import PolicyGradientConfig


@RLAlgorithmConfig.register_subclass("grpo")
@dataclass
class GRPOConfig(PolicyGradientConfig):
    """Group relative policy optimisation (Shao et al. 2024): episodes from one start are compared with each
    other, so that no value is needed; with the asymmetric clip and dynamic sampling of DAPO (Yu et al. 2025).

    Args:
        group_size: environments that begin alike; divides --num_envs.
        clip_low, clip_high: how far a ratio is free to move below and above 1.
        least_group_std: groups whose returns have a smaller standard deviation teach nothing and are left
            out: with a reward of about 1 for success, those that all succeeded or all failed.
        reference_coefficient: weight of KL(policy || cloned policy); GRPO needs none.
    """

    group_size: int = 8
    clip_low: float = 0.2
    clip_high: float = 0.28
    least_group_std: float = 0.05
    reference_coefficient: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_share("clip_low", "clip_high")
        self.require_positive("least_group_std")
        if self.group_size < 2:
            raise ValueError(f"algorithm.group_size={self.group_size}: must be at least 2 to compare")
