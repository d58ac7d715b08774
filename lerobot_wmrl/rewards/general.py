"""The general reward (eqs. 5-8, Algorithm 1): success in the action model, progress to the goal frame."""

import torch
from torch import Tensor


def sparse_reward(done_logit: Tensor, threshold: float) -> Tensor:
    """Eq. 7: 1 where the done probability reaches θ. (B,) → (B,)"""
    return (done_logit.sigmoid() >= threshold).float()


def dense_reward[Number: (float, Tensor)](
    similarity: Number, previous: Number, form: str, gamma: float
) -> Number:
    """Eq. 5, as it stands (`absolute`) or as the potential difference γ·s_t − s_{t−1}. (B,), (B,) → (B,)

    The potential form telescopes: an episode earns γ^T·s_T − s_0 in all, so lingering near the goal costs a
    little. A success keeps its last γ·s_T, as a bonus for ending like the goal (Ng et al. 1999 would take it
    back); with α near 1 it is small beside the sparse reward.
    """
    return similarity if form == "absolute" else gamma * similarity - previous


def general_reward[Number: (float, Tensor)](
    sparse: Number, similarity: Number, previous: Number, *, alpha: float, form: str, gamma: float
) -> Number:
    """Algorithm 1: α·R_sps + (1 − α)·R_den. All (B,), or numbers."""
    return alpha * sparse + (1 - alpha) * dense_reward(similarity, previous, form, gamma)


def check_shape(alpha: float, form: str, gamma: float) -> None:
    """ValueError unless there is such a reward."""
    if form not in ("absolute", "potential"):
        raise ValueError(f"--reward.form={form}: choose absolute or potential")
    if not 0 <= alpha <= 1:
        raise ValueError(f"--reward.alpha={alpha}: choose a weight in [0, 1]")
    if not 0 < gamma <= 1:
        raise ValueError(f"--reward.gamma={gamma}: choose a discount above 0, at most 1")


def consecutive_count(count: Tensor, fired: Tensor) -> Tensor:
    """Length of the present run of frames on which done fired. count (B,) int, fired (B,) bool → (B,)"""
    return torch.where(fired, count + 1, torch.zeros_like(count))
