"""Physics-IQ (Motamed et al. 2025): does what moves, move where and when it should?"""

import torch
from torch import Tensor


def spatial_iou(real: Tensor, imagined: Tensor) -> Tensor:
    """Where: overlap of the pixels that moved at any time. Masks (T, …) bool → (), NaN if nothing moved."""
    return _ratio((real.any(0) & imagined.any(0)).sum(), (real.any(0) | imagined.any(0)).sum())


def spatiotemporal_iou(real: Tensor, imagined: Tensor) -> Tensor:
    """Where and when: overlap of each frame's moved pixels, averaged over the frames with any. → ()"""
    overlap = (real & imagined).flatten(1).sum(1)
    return _ratio(overlap, (real | imagined).flatten(1).sum(1)).nanmean()


def weighted_spatial_iou(real: Tensor, imagined: Tensor) -> Tensor:
    """Where and how much: Σ min / Σ max of the shares of time in which pixels differ. → ()"""
    often, imagined_often = real.float().mean(0), imagined.float().mean(0)
    return _ratio(torch.minimum(often, imagined_often).sum(), torch.maximum(often, imagined_often).sum())


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    return torch.where(whole > 0, part / whole, torch.nan)
