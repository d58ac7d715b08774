"""Mean and standard deviation of returns, so that a value network sees targets of unit size."""

import torch
from torch import Tensor

from lerobot_wmrl.common.distributed import mean_and_variance

DECAY = 0.9
"""How much of what is known of the returns an iteration keeps: policies improve, returns with them."""

LEAST_STD = 1e-4


class ReturnScale:
    """Moments of the last iterations' returns, bias-corrected as Adam's are; the identity before the first.

    `tensors`, all (): the moments as they are summed up, and the weight that the sum has.
    """

    def __init__(self, device: torch.device | str) -> None:
        names = ("mean", "square", "weight")
        self.tensors = {name: torch.zeros((), dtype=torch.float64, device=device) for name in names}

    def update(self, returns: Tensor) -> None:
        """Take in an iteration's returns, of all processes. (N,)"""
        mean, variance = mean_and_variance(returns.double())
        seen = {"mean": mean, "square": variance + mean.square(), "weight": torch.ones_like(mean)}
        for name, value in seen.items():
            self.tensors[name].lerp_(value, 1 - DECAY)

    def _mean_and_std(self) -> tuple[Tensor, Tensor]:
        weight = self.tensors["weight"]
        known = weight > 0
        mean, square = (self.tensors[name] / weight.clamp_min(1e-12) for name in ("mean", "square"))
        std = (square - mean.square()).clamp_min(LEAST_STD**2).sqrt()
        return torch.where(known, mean, 0.0), torch.where(known, std, 1.0)

    def normalise(self, returns: Tensor) -> Tensor:
        """Returns in units of their standard deviation, from their mean."""
        mean, std = self._mean_and_std()
        return ((returns - mean) / std).to(returns.dtype)

    def restore(self, normalised: Tensor) -> Tensor:
        """The inverse of `normalise`."""
        mean, std = self._mean_and_std()
        return (normalised * std + mean).to(normalised.dtype)
