"""Configuration of the general reward."""

from dataclasses import dataclass

from lerobot.configs.rewards import RewardModelConfig


@RewardModelConfig.register_subclass("general")
@dataclass
class GeneralConfig(RewardModelConfig):
    """Algorithm 1's reward.

    Args:
        alpha: weight α of the sparse part; the dense part has 1 − α.
        form: `potential` pays for getting closer to the goal frame, `absolute` (the paper's) for being close.
        gamma: discount of the potential form; give it the algorithm's discount.
    """

    alpha: float = 0.9
    form: str = "potential"
    gamma: float = 0.97

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in ("absolute", "potential"):
            raise ValueError(f"--reward.form={self.form}: choose absolute or potential")
        if not 0 <= self.alpha <= 1:
            raise ValueError(f"--reward.alpha={self.alpha}: choose a weight in [0, 1]")
