"""The cross-entropy method on action sequences. K samples, T frames, A action components."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

LEAST_SPREAD = 0.05
"""Share of the first spread below which the draws do not shrink."""

Objective = Callable[[Tensor], Tensor]
"""Sequences (K, T, A) → how good they are (K,)."""


def interpolated(knots: Tensor, horizon: int) -> Tensor:
    """Knots (K, N, A), evenly spaced → sequences (K, horizon, A)."""
    return F.interpolate(knots.transpose(1, 2), horizon, mode="linear", align_corners=True).transpose(1, 2)


def best_knots(
    objective: Objective, mean: Tensor, spread: Tensor, low: Tensor, high: Tensor, *,
    horizon: int, samples: int, elites: int, iterations: int, generator: torch.Generator,
) -> Tensor:  # fmt: skip
    """The best knots (N, A) that were met: the mean (N, A) and spread (A,) go to those of the `elites`.

    The first mean and all later ones are among what is judged, so nothing worse than them is returned.
    """
    first, deviation = spread, spread.expand_as(mean)
    best, best_value = mean, -torch.inf
    for _ in range(iterations):
        noise = torch.randn(samples, *mean.shape, generator=generator, device=mean.device)
        knots = (mean + deviation * noise).clamp(low, high)
        knots[0] = mean
        value = objective(interpolated(knots, horizon))
        top = value.topk(elites).indices
        if value[top[0]] > best_value:
            best, best_value = knots[top[0]], float(value[top[0]])
        mean = knots[top].mean(0)
        deviation = torch.maximum(knots[top].std(0, unbiased=False), LEAST_SPREAD * first)
    return best


def longest_success(done_logit: Tensor, frames: int) -> Tensor:
    """The highest logit at which done would hold for `frames` frames in a row. (K, T) → (K,)"""
    return done_logit.unfold(1, frames, 1).amin(-1).amax(1)
