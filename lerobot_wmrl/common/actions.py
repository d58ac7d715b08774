"""Actions out of range: clipped, counted and reported."""

import logging
from collections.abc import Sequence

import numpy as np
from torch import Tensor


def clip_actions(actions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Clip actions (B, A) to their range, (A,) each.

    Returns:
        The clipped actions (B, A), NaN where they were NaN, and the share of components that were clipped
        (B,).
    """
    clipped = actions.clamp(low, high)
    return clipped, (~actions.isclose(clipped, equal_nan=True)).float().mean(1)


def warn_of_clipped(shares: Sequence[float]) -> None:
    """Warn if components of actions were clipped; `shares` has one value for each action."""
    if any(shares):
        logging.warning(
            "%.1f %% of the components of the actions were out of range, and clipped to it",
            100 * np.mean(shares),
        )
