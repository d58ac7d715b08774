"""How well the done signal is predicted: frame by frame, episode by episode, and how late."""

from typing import Final

import numpy as np

from lerobot_wmrl.common.statistics import Estimate
from lerobot_wmrl.evaluation.gate import Outcomes

SMALLEST: Final = 1e-6
"""Probability that counts for what was thought impossible and happened."""


def precision_recall_f1(called: np.ndarray, real: np.ndarray) -> dict[str, Estimate]:
    """Of (E, …) bool, pooled over everything, with episodes as what is drawn for the intervals."""
    axes = tuple(range(1, called.ndim))
    hit, called_count, real_count = (mask.sum(axes) for mask in (called & real, called, real))
    return {
        "precision": Estimate.ratio(hit, called_count),
        "recall": Estimate.ratio(hit, real_count),
        "f1": Estimate.ratio(2 * hit, called_count + real_count),
    }


def done_delay(outcomes: Outcomes, threshold: float, frames: int) -> np.ndarray:
    """Frames from the real to the imagined first success of each episode, NaN unless it has both. (E,)"""
    begin = outcomes.first_predicted_success(threshold, frames)
    return np.where((begin >= 0) & outcomes.success, begin - outcomes.done.argmax(1), np.nan)


def done_log_loss(outcomes: Outcomes) -> Estimate:
    """Mean negative log-likelihood of what happened, in nats a frame, without any threshold."""
    frames = ~np.isnan(outcomes.probability)
    likelihood = np.where(outcomes.done, outcomes.probability, 1 - outcomes.probability)
    losses = np.where(frames, -np.log(np.clip(likelihood, SMALLEST, 1)), 0)
    return Estimate.ratio(losses.sum(1), frames.sum(1))


def done_quality(outcomes: Outcomes, threshold: float, frames: int) -> dict[str, Estimate]:
    """`done_*` over frames at `threshold`, `episode_*` as the environment ends episodes, log loss, delay."""
    fired = outcomes.probability >= threshold
    called = outcomes.first_predicted_success(threshold, frames) >= 0
    per_frame = precision_recall_f1(fired, outcomes.done)
    per_episode = precision_recall_f1(called, outcomes.success)
    delay = done_delay(outcomes, threshold, frames)
    return {
        **{f"done_{name}": estimate for name, estimate in per_frame.items()},
        **{f"episode_{name}": estimate for name, estimate in per_episode.items()},
        "done_log_loss": done_log_loss(outcomes),
        "done_delay_frames": Estimate.mean(delay),
        "done_distance_frames": Estimate.mean(np.abs(delay)),
    }
