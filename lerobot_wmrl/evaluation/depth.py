"""How close depth maps are (Eigen et al. 2014): the relative error, and the share of nearly right pixels."""

import torch
from torch import Tensor

NEARLY_RIGHT = 1.25


def abs_rel(imagined: Tensor, real: Tensor) -> Tensor:
    """Mean |d − d*| / d* over pixels whose real depth d* is known (> 0). (T, …) metres → (T,)"""
    return _mean_of_known((imagined - real).abs() / real, real)


def delta_share(imagined: Tensor, real: Tensor, power: int) -> Tensor:
    """δₙ: share of pixels with max(d/d*, d*/d) < 1.25ⁿ. (T, …) metres → (T,)"""
    ratio = torch.maximum(imagined / real, real / imagined)
    return _mean_of_known(((ratio < NEARLY_RIGHT**power) & (imagined > 0)).float(), real)


def depth_accuracy(imagined: Tensor, real: Tensor) -> dict[str, Tensor]:
    """All three of maps (T, N, H, W) in metres; each (T,), NaN where no depth is known."""
    return {
        "abs_rel": abs_rel(imagined, real),
        "delta_1": delta_share(imagined, real, 1),
        "delta_2": delta_share(imagined, real, 2),
    }


def _mean_of_known(values: Tensor, real: Tensor) -> Tensor:
    return torch.where(real > 0, values, torch.nan).flatten(1).nanmean(1)
