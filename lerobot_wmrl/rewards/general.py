"""The general reward (eqs. 5-8, Algorithm 1): success, and progress towards the goal frame.

Read it top to bottom. The world model's done logits give success (eq. 7). The similarity to the goal frame,
which the text world model imagines (eq. 6, `world_models.goal`), gives progress (eq. 5). `similarity.py`
measures it. B is the number of environments.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError, require_choice, require_share

FORMS: Final = ("absolute", "potential")

LATEST_WORTH: Final = 0.3
"""What the discount leaves of a success in the last step that an episode may take. A smaller discount factor
hurries the policy, at costs that the world model may not see."""

LARGEST_DISCOUNT: Final = 0.999

DEFAULT_ALPHA: Final = 0.9
"""Weight of success, where progress counts too."""


def default_discount(longest: int) -> float:
    """Return the discount factor for episodes of up to `longest` steps, in thousandths."""
    return min(LARGEST_DISCOUNT, round(LATEST_WORTH ** (1 / longest), 3))


def is_done(done_logit: Tensor, threshold: float) -> Tensor:
    """Whether the done probability reaches θ (eq. 7). (B,) → (B,) bool"""
    return done_logit.sigmoid() >= threshold


def consecutive_count(count: Tensor, fired: Tensor) -> Tensor:
    """Return the length of the present run of done frames. count (B,) int, fired (B,) bool → (B,)"""
    return torch.where(fired, count + 1, torch.zeros_like(count))


def dense_reward[Number: (float, Tensor)](
    similarity: Number, previous: Number, form: str, gamma: float
) -> Number:
    """Eq. 5 as published (`absolute`), or as the potential difference γ·s_t − s_{t−1}. (B,), (B,) → (B,)

    Discounted, the potential form sums to γ^T·s_T − s_0: staying near the goal costs (1 − γ)·s a step. Ng et
    al. (1999) subtract the final γ·s_T; here a success keeps it, which with α near 1 is small beside the
    sparse reward.
    """
    return similarity if form == "absolute" else gamma * similarity - previous


def general_reward[Number: (float, Tensor)](
    sparse: Number, similarity: Number, previous: Number, *, alpha: float, form: str, gamma: float
) -> Number:
    """Algorithm 1 (eq. 8): α·R_sps + (1 − α)·R_den. Each argument is (B,) or a number."""
    return alpha * sparse + (1 - alpha) * dense_reward(similarity, previous, form, gamma)


class GeneralRewardSettings(Protocol):
    """What the configurations of the general reward have in common, in imagination and in a simulator."""

    @property
    def alpha(self) -> float | None: ...

    form: str
    gamma: float | None


def check_general_reward(settings: GeneralRewardSettings) -> None:
    """Raise FieldError for the first of the settings that is out of its range."""
    require_choice(settings, "form", FORMS)
    if settings.alpha is not None:
        require_share(settings, "alpha")
    if settings.gamma is not None and not 0 < settings.gamma <= 1:
        raise FieldError("gamma", settings.gamma, "must be a discount above 0 and at most 1")


def potential_discount(settings: GeneralRewardSettings, longest: int) -> float:
    """Return the discount of the potential form, in an environment of episodes of up to `longest` steps."""
    return default_discount(longest) if settings.gamma is None else settings.gamma


@dataclass
class RuleBasedReward:
    """The general reward of a simulator: its success, and the task's own measure of progress as similarity.

    Args:
        alpha: weight of success; progress has 1 − alpha.
        form: `potential` pays for progress made. `absolute` pays for being far on in every step; since
            success ends an episode, that can be worth more than success.
        gamma: discount of the potential form, which should be PPO's; by default PPO's default, and 1 for
            GRPO, which adds rewards up without one.
    """

    alpha: float = DEFAULT_ALPHA
    form: str = "potential"
    gamma: float | None = None

    def __post_init__(self) -> None:
        check_general_reward(self)

    def step_reward[Number: (float, Tensor)](
        self, success: Number, progress: Number, previous: Number, longest: int
    ) -> Number:
        """Return the reward of a step from `previous` to `progress` in [0, 1]. (B,) each, or numbers.

        `longest` is the number of steps that an episode may take.
        """
        return general_reward(
            success,
            progress,
            previous,
            alpha=self.alpha,
            form=self.form,
            gamma=potential_discount(self, longest),
        )
