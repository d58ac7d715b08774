"""The cross-entropy method on action sequences. K samples, T frames, A action components."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

MIN_STD_SHARE = 0.05
"""Share of the first standard deviation below which it does not shrink."""

Objective = Callable[[Tensor], Tensor]
"""Value of action sequences: (K, T, A) → (K,)."""


def interpolate_knots(knots: Tensor, horizon: int) -> Tensor:
    """Interpolate evenly spaced knots (K, N, A) linearly. → (K, horizon, A)"""
    return F.interpolate(knots.transpose(1, 2), horizon, mode="linear", align_corners=True).transpose(1, 2)


def plan_knots(
    objective: Objective, mean: Tensor, std: Tensor, low: Tensor, high: Tensor, *,
    horizon: int, samples: int, elites: int, iterations: int, generator: torch.Generator,
) -> Tensor:  # fmt: skip
    """Return the best knots (N, A) that the cross-entropy method finds.

    Every mean is among the evaluated sequences, so the result is no worse than any of them.

    Args:
        objective: value of action sequences.
        mean: knots to begin with (N, A). std: of the first samples (A,). low, high: bounds of actions (A,).
    """
    first, deviation = std, std.expand_as(mean)
    best, best_value = mean, -torch.inf
    for _ in range(iterations):
        noise = torch.randn(samples, *mean.shape, generator=generator, device=mean.device)
        knots = (mean + deviation * noise).clamp(low, high)
        knots[0] = mean
        value = objective(interpolate_knots(knots, horizon))
        top = value.topk(elites).indices
        if value[top[0]] > best_value:
            best, best_value = knots[top[0]], float(value[top[0]])
        mean = knots[top].mean(0)
        deviation = torch.maximum(knots[top].std(0, unbiased=False), MIN_STD_SHARE * first)
    return best


def success_logit(done_logit: Tensor, frames: int) -> Tensor:
    """Return the highest logit at which done holds for `frames` consecutive frames. (K, T) → (K,)"""
    return done_logit.unfold(1, frames, 1).amin(-1).amax(1)
