"""Terms of the loss of PPO and GRPO: the clipped objective and the KL penalty.

B decisions, K action components, J ratios of a decision, n steps of an action chunk.
"""

import torch
from torch import Tensor


def log_ratios(log_prob_change: Tensor, kind: str) -> Tensor:
    """Return log-ratios of whole actions (B, 1) or of each token (B, K) from the components' (B, K)."""
    return log_prob_change if kind == "token" else log_prob_change.sum(dim=1, keepdim=True)


def clipped_objective(log_ratio: Tensor, advantage: Tensor, low: float, high: float) -> Tensor:
    """Return −min(r A, clip(r, 1 − low, 1 + high) A), r = exp(log_ratio) (Schulman et al. 2017, eq. 7).

    (B, J), (B,) → (B, J)
    """
    ratio, advantage = log_ratio.exp(), advantage[:, None]
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - low, 1 + high) * advantage)


def outside_clip(log_ratio: Tensor, low: float, high: float) -> Tensor:
    """Return 1 where a ratio has left the interval in which it may move. (B, J) → (B, J)"""
    ratio = log_ratio.exp()
    return ((ratio < 1 - low) | (ratio > 1 + high)).to(ratio.dtype)


def kl_estimate(log_prob: Tensor, other: Tensor) -> Tensor:
    """Estimate KL(p ‖ q) on samples of p by r − 1 − log r, r = q / p (Schulman 2020). (B, K), (B, K) → (B,)

    `log_prob` is log p of each component, `other` is log q.
    """
    log_ratio = (other - log_prob).sum(dim=1)
    return log_ratio.exp() - 1 - log_ratio


def reference_penalty(log_prob: Tensor, reference: Tensor) -> Tensor:
    """Return ½ Σ (log π − log π_ref)² over the components. (B, K), (B, K) → (B,)

    Its mean gradient on π's samples is that of KL(π ‖ π_ref) for independent components; per token it ignores
    what a token does to later ones.
    """
    return 0.5 * (log_prob - reference).square().sum(dim=1)


def steps_of(executed: Tensor) -> Tensor:
    """Return how many steps of a decision's actions were executed, at least 1. (B, n, 1) or (B, 1) → (B,)"""
    return executed.flatten(1).sum(dim=1).clamp_min(1)
