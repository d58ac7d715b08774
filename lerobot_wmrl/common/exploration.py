"""Noise on a policy's actions while it is recorded."""

from typing import Final

import numpy as np

EXPLORATION_STREAM: Final = 1 << 20
"""Separates the random stream of this noise from that of the starts, seeded by (seed, task, scene)."""

NOISE_MEMORY: Final = 0.9
"""Autocorrelation of exploration noise from one step to the next: it lasts about ten steps."""


class ExplorationNoise:
    """First-order autoregressive noise on actions, its level drawn once an episode.

    Independent noise averages out within a few steps. This noise leads an episode away from the policy's
    trajectory, to where the policy may be once it has changed.

    Args:
        largest: the highest of the noise levels, as a share of `scale`.
        seed: seed of the episode.
        scale: half the range of each component, in the units of actions. (A,)
    """

    def __init__(self, largest: float, seed: int, scale: np.ndarray) -> None:
        self.rng = np.random.default_rng((seed, EXPLORATION_STREAM))
        self.level = self.rng.uniform(0.0, largest) * scale
        self.state = self.rng.normal(size=len(scale))

    def __call__(self) -> np.ndarray:
        """Return what to add to the next action. (A,)"""
        offset = self.level * self.state
        fresh = np.sqrt(1.0 - NOISE_MEMORY**2) * self.rng.normal(size=len(self.level))
        self.state = NOISE_MEMORY * self.state + fresh
        return offset
