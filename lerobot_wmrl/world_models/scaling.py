"""How a world model scales states and actions: by mean and standard deviation of its dataset."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

MIN_STD: Final = 1e-3
"""Standard deviation below which a component is a constant, and not scaled: in the dataset's units, for small
actions in halves of their component's range."""

ROUNDING: Final = 1e-6
"""Standard deviation that rounding may give a constant component, as a share of its mean, or of 1."""

STATE_MIN_STD: Final = 0.02
"""Least standard deviation by which the state is scaled, in the dataset's units. The opening of a closed
gripper or the rotation of a hand held upright hardly varies: scaled by less, its noise would weigh as much as
centimetres."""

REACH: Final = 5.0
"""Standard deviations to which the scaled state is clamped: rare collisions do not outweigh the rest."""

FREQUENT: Final = 0.995
"""Share of the frames whose state is not clamped: a gripper that is open in one of a hundred frames may be
ten standard deviations from its mean then."""


class Scale(NamedTuple):
    """Mean and standard deviation of each component, (size,) each."""

    mean: Tensor
    std: Tensor

    @classmethod
    def of(
        cls, size: int, stats: Mapping[str, Any] | None, least: float = 0.0, unit: Tensor | float = 1.0
    ) -> "Scale":
        """Read a feature's statistics; without any, zeros and ones.

        Args:
            size: components of the feature.
            stats: a dataset's statistics of it.
            least: least standard deviation.
            unit: unit in which `MIN_STD` is measured, one for each component or for all.
        """
        mean, std = torch.zeros(size), torch.ones(size)
        if stats and size:
            mean = torch.as_tensor(stats["mean"], dtype=torch.float32)
            std = torch.as_tensor(stats["std"], dtype=torch.float32)
            std = std.where(std != 1, 1 + torch.finfo(std.dtype).eps)  # 1 says that it never varies
            constant = torch.maximum(torch.as_tensor(MIN_STD * unit), ROUNDING * mean.abs().clamp_min(1))
            std = torch.where(std <= constant, 1.0, std).clamp_min(least)
        return cls(mean, std)

    def reach(self, recorded: np.ndarray | None) -> Tensor:
        """Return the standard deviations to which components are clamped: `REACH`, or as far as `FREQUENT` of
        the recorded values (rows, size) go beyond. (size,)"""
        if recorded is None or not len(recorded):
            return torch.full_like(self.std, REACH)
        distance = np.abs(recorded - self.mean.numpy()) / self.std.numpy()
        frequent = np.nanquantile(np.where(np.isfinite(distance), distance, np.nan), FREQUENT, axis=0)
        return torch.as_tensor(frequent, dtype=torch.float32).nan_to_num(REACH).clamp_min(REACH)
