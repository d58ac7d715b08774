"""Normalisation of returns for the value function, `algorithm.value_normalisation`."""

import torch
from torch import Tensor

from lerobot_wmrl.common.distributed import mean_and_variance

SCALE_DECAY = 0.9
"""Weight of earlier iterations in the running moments. Low, because returns grow as the policy improves."""

LEAST_STD = 1e-4


class ReturnScale:
    """Running mean and standard deviation of returns, so that the value function sees targets of unit size.

    Moments are bias-corrected as Adam's are. Before the first update this is the identity. They are kept in
    float64 on the CPU, since Apple's GPUs have none.
    """

    def __init__(self) -> None:
        names = ("mean", "square", "weight")
        self.tensors = {name: torch.zeros((), dtype=torch.float64) for name in names}

    def update(self, returns: Tensor) -> None:
        """Update the moments with the returns (N,) of one iteration, of all processes."""
        mean, variance = (moment.cpu().double() for moment in mean_and_variance(returns.float()))
        moments = {"mean": mean, "square": variance + mean.square(), "weight": torch.ones_like(mean)}
        for name, value in moments.items():
            self.tensors[name].lerp_(value, 1 - SCALE_DECAY)

    def _mean_and_std(self) -> tuple[Tensor, Tensor]:
        weight = self.tensors["weight"]
        known = weight > 0
        mean, square = (self.tensors[name] / weight.clamp_min(1e-12) for name in ("mean", "square"))
        std = (square - mean.square()).clamp_min(LEAST_STD**2).sqrt()
        return torch.where(known, mean, 0.0).float(), torch.where(known, std, 1.0).float()

    def normalise(self, returns: Tensor) -> Tensor:
        """Subtract the mean and divide by the standard deviation."""
        mean, std = (moment.to(returns.device) for moment in self._mean_and_std())
        return ((returns - mean) / std).to(returns.dtype)

    def restore(self, normalised: Tensor) -> Tensor:
        """Undo `normalise`."""
        mean, std = (moment.to(normalised.device) for moment in self._mean_and_std())
        return (normalised * std + mean).to(normalised.dtype)
