"""The general reward (eqs. 5-8, Algorithm 1): success, and progress towards the goal frame.

Read it top to bottom. The world model's done logits give success (eq. 7). The similarity to the goal frame,
which the text world model imagines (eq. 6, `world_models.goal`), gives progress (eq. 5). `similarity.py`
measures it. B is the number of environments.
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError, require_choice, require_share

FORMS: Final = ("absolute", "potential")


def sparse_reward(done_logit: Tensor, threshold: float) -> Tensor:
    """Eq. 7: 1 where the done probability reaches θ. (B,) → (B,)"""
    return (done_logit.sigmoid() >= threshold).float()


def consecutive_count(count: Tensor, fired: Tensor) -> Tensor:
    """Return the length of the present run of done frames. count (B,) int, fired (B,) bool → (B,)"""
    return torch.where(fired, count + 1, torch.zeros_like(count))


def dense_reward[Number: (float, Tensor)](
    similarity: Number, previous: Number, form: str, gamma: float
) -> Number:
    """Eq. 5 as published (`absolute`), or as the potential difference γ·s_t − s_{t−1}. (B,), (B,) → (B,)

    The potential form telescopes: an episode earns γ^T·s_T − s_0 in all, so lingering near the goal costs a
    little. A success keeps its last γ·s_T as a bonus for ending like the goal. Ng et al. (1999) would take it
    back; with α near 1 it is small beside the sparse reward.
    """
    return similarity if form == "absolute" else gamma * similarity - previous


def general_reward[Number: (float, Tensor)](
    sparse: Number, similarity: Number, previous: Number, *, alpha: float, form: str, gamma: float
) -> Number:
    """Algorithm 1 (eq. 8): α·R_sps + (1 − α)·R_den. Each argument is (B,) or a number."""
    return alpha * sparse + (1 - alpha) * dense_reward(similarity, previous, form, gamma)


def check_general_reward(settings: object) -> None:
    """Raise FieldError unless `alpha`, `form` and `gamma` of `settings` are those of a general reward."""
    require_choice(settings, "form", FORMS)
    require_share(settings, "alpha")
    gamma = getattr(settings, "gamma")  # noqa: B009 (two configurations have it, without a common base)
    if not 0 < gamma <= 1:
        raise FieldError("gamma", gamma, "must be a discount above 0 and at most 1")


@dataclass
class RuleBasedReward:
    """The general reward of a simulator: its success, and the task's own measure of progress as similarity.

    Args:
        alpha: weight of success; progress has 1 − alpha.
        form: `potential` pays for progress made. `absolute` pays for being far on in every step; since
            success ends an episode, that can be worth more than success.
        gamma: discount of the potential form; give it the algorithm's discount.
    """

    alpha: float = 0.9
    form: str = "potential"
    gamma: float = 0.97

    def __post_init__(self) -> None:
        check_general_reward(self)

    def step_reward[Number: (float, Tensor)](
        self, success: Number, progress: Number, previous: Number
    ) -> Number:
        """Return the reward of a step from `previous` to `progress` in [0, 1]. (B,) each, or numbers."""
        return general_reward(success, progress, previous, alpha=self.alpha, form=self.form, gamma=self.gamma)
