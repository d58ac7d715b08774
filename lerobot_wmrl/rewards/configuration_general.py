"""Configuration of the general reward."""

from dataclasses import dataclass
from typing import Final

from lerobot.configs.rewards import RewardModelConfig

from lerobot_wmrl.rewards.general import check_shape

LPIPS_BACKBONES: Final = {"lpips_alex": "alex", "lpips_vgg": "vgg"}
SIMILARITIES: Final = ("tokenizer", *LPIPS_BACKBONES, "mse")


@RewardModelConfig.register_subclass("general")
@dataclass
class GeneralConfig(RewardModelConfig):
    """Algorithm 1's reward.

    Args:
        alpha: weight α of the sparse part; the dense part has 1 − α.
        form: `potential` pays for getting closer to the goal frame, `absolute` (the paper's) for being close.
        gamma: discount of the potential form; give it the algorithm's discount.
        similarity: `tokenizer`, 1 − LPIPS's formula on the tokenizer's features; `lpips_alex` or `lpips_vgg`,
            1 − LPIPS, whose backbone must be in torch's cache; `mse`, 1 − the mean squared error.
    """

    alpha: float = 0.9
    form: str = "potential"
    gamma: float = 0.97
    similarity: str = "tokenizer"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape(self.alpha, self.form, self.gamma)
        if self.similarity not in SIMILARITIES:
            raise ValueError(f"--reward.similarity={self.similarity}: choose {', '.join(SIMILARITIES)}")

    @property
    def needs_goal(self) -> bool:
        """Whether there is a dense part, which only a goal frame can pay."""
        return self.alpha < 1
