"""When predicted success counts as an episode's success: a threshold, held for some frames."""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lerobot_wmrl.common.constants import DONE_FRAMES, DONE_THRESHOLD


@dataclass(frozen=True, order=True)
class SuccessCriterion:
    """An episode succeeds when the done probability reaches the threshold in consecutive frames (eq. 7).

    Args:
        threshold: done probability θ from which a frame counts as done.
        frames: consecutive frames k that must be done.
    """

    threshold: float = DONE_THRESHOLD
    frames: int = DONE_FRAMES

    def __str__(self) -> str:
        return f"done_threshold={self.threshold} and done_frames={self.frames}"

    def first_met(self, probability: np.ndarray) -> np.ndarray:
        """Return the first of the frames in which it is met, −1 if it never is. (E, T) → (E,)"""
        return first_run(probability >= self.threshold, self.frames)


def first_run(fired: np.ndarray, frames: int) -> np.ndarray:
    """Return where the first run of `frames` consecutive True begins, −1 if there is none. (E, T) → (E,)"""
    if fired.shape[1] < frames:
        return np.full(len(fired), -1)
    runs = sliding_window_view(fired, frames, axis=1).min(-1)  # whether one begins there
    return np.where(runs.max(1), runs.argmax(1), -1)
