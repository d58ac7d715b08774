"""What policies and values are trained on, step by step. B steps, J ratios a step, K action components."""

import torch
import torch.nn.functional as F
from torch import Tensor


def log_ratios(moved: Tensor, kind: str) -> Tensor:
    """Log-ratios of decisions from those of their components, `moved` (B, K).

    `action`: one ratio a decision, its components' product. (B, 1) `token`: one a component. (B, K)
    """
    return moved if kind == "token" else moved.sum(dim=1, keepdim=True)


def clipped_objective(log_ratio: Tensor, advantage: Tensor, low: float, high: float) -> Tensor:
    """Schulman et al. 2017, eq. 7, as a loss: −min(r A, clip(r, 1 − low, 1 + high) A), r = exp(log_ratio).

    (B, J), (B,) → (B, J)
    """
    ratio, advantage = log_ratio.exp(), advantage[:, None]
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - low, 1 + high) * advantage)


def outside_clip(log_ratio: Tensor, low: float, high: float) -> Tensor:
    """1 where a ratio has left the interval in which it is free to move. (B, J) → (B, J)"""
    ratio = log_ratio.exp()
    return ((ratio < 1 - low) | (ratio > 1 + high)).to(ratio.dtype)


def kl_estimate(log_prob: Tensor, other: Tensor) -> Tensor:
    """KL(sampling ‖ other) by samples: r − 1 − log r, r = other / sampling (Schulman 2020). (B, K) → (B,)"""
    log_ratio = (other - log_prob).sum(dim=1)
    return log_ratio.exp() - 1 - log_ratio


def reference_penalty(log_prob: Tensor, reference: Tensor) -> Tensor:
    """½ (log π − log π_ref)², whose gradient on π's samples is that of KL(π ‖ π_ref). (B, K) → (B,)"""
    return 0.5 * (log_prob - reference).square().sum(dim=1)


def huber_value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Quadratic up to an error of 1, linear beyond. (B,) → (B,)"""
    return F.huber_loss(value, target, reduction="none")


def clipped_value_loss(value: Tensor, target: Tensor, old: Tensor, clip: float) -> Tensor:
    """½ max((V − R)², (V_old + clip(V − V_old) − R)²): nothing is gained beyond `clip`. (B,) → (B,)"""
    kept_near = old + (value - old).clamp(-clip, clip)
    return 0.5 * torch.maximum((value - target).square(), (kept_near - target).square())
