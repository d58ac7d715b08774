"""From success counted in a world model to success in reality, with an interval.

A world model takes some failures for successes and misses some successes. Labelled rollouts that are replayed
in it say how often, and by that the success rate in imagination can be corrected. This supposes that the
world model errs about a policy as it does about the rollouts. With policies whose real success is known, the
references, it need not be supposed: a line through their rates predicts the real one.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from lerobot_wmrl.common.statistics import Proportion

LEAST_REFERENCES = 3
"""Fewer leave no line without one of them."""


class Confusion(NamedTuple):
    """What a world model says of labelled episodes: the share of the successes that it predicts as successes
    (`recall`), and of the failures (`false_positives`)."""

    recall: Proportion
    false_positives: Proportion

    @property
    def youden(self) -> float:
        """Recall less the false positive rate (Youden 1950): 1 is perfect, 0 is chance; NaN without both."""
        return self.recall.share - self.false_positives.share


class RateEstimate(NamedTuple):
    """A success rate and an interval for it. A correction may take all three beyond 0 and 1."""

    value: float
    low: float
    high: float

    def clipped(self) -> "RateEstimate":
        """Return the part of it that is within 0 and 1."""
        return RateEstimate(*(min(1.0, max(0.0, each)) for each in self))

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f} %)"


def corrected_rate(imagined: Proportion, confusion: Confusion, coverage: float) -> RateEstimate:
    """Correct a success rate for false positives and for recall (Rogan and Gladen 1978).

    Its interval takes into account that all three rates are estimated (Lang and Reiczigel 2014).

    Args:
        imagined: episodes that succeed in the world model.
        confusion: the world model's, on episodes other than those.
        coverage: share of such intervals that contain the real rate.

    Raises:
        ValueError: the world model predicts success for failures at least as often as for successes.
    """
    z = float(norm.ppf((1 + coverage) / 2))
    n, successes, failures = imagined.n + z * z, confusion.recall.n + 2, confusion.false_positives.n + 2
    rate = (imagined.k + z * z / 2) / n
    recall = (confusion.recall.k + 1) / successes
    false_positives = (confusion.false_positives.k + 1) / failures
    youden = recall - false_positives
    if not confusion.youden > 0 or youden <= 0:
        raise ValueError("the world model does not tell successes from failures: nothing can be corrected")
    value = (imagined.share - confusion.false_positives.share) / confusion.youden
    centre = (rate - false_positives) / youden
    recall_variance = recall * (1 - recall) / successes
    false_variance = false_positives * (1 - false_positives) / failures
    shift = 2 * z * z * (centre * recall_variance - (1 - centre) * false_variance)
    variance = rate * (1 - rate) / n + centre**2 * recall_variance + (1 - centre) ** 2 * false_variance
    half = z * math.sqrt(variance) / youden
    low, high = centre + shift - half, centre + shift + half
    return RateEstimate(value, min(value, low), max(value, high))


def calibrated_rate(
    imagined: float, references: Sequence[tuple[float, float]], coverage: float
) -> RateEstimate | None:
    """Predict a policy's real success rate by the line through the references' rates (least squares).

    The interval is jackknife+ (Barber et al. 2021): the errors about each reference by the line through all
    others. If a policy and its references are exchangeable it contains the rate with a probability of at
    least 2 · coverage − 1, and of about `coverage` where the line hardly depends on single references.

    Args:
        imagined: success rate in the world model.
        references: rates in the world model and in reality.
        coverage: share of such intervals that contain the real rate.

    Returns:
        Nothing if there are too few references: 0.9 needs 9, 0.95 needs 19.
    """
    rank = math.ceil((len(references) + 1) * coverage)
    if len(references) < max(rank, LEAST_REFERENCES):
        return None
    predicted, real = np.array(references).T
    kept = ~np.eye(len(predicted), dtype=bool)
    lines = [_line(predicted[mask], real[mask]) for mask in kept]
    errors = np.abs([y - line(x) for line, x, y in zip(lines, predicted, real, strict=True)])
    values = np.array([line(imagined) for line in lines])
    low, high = np.sort(values - errors)[-rank], np.sort(values + errors)[rank - 1]
    value = float(np.clip(_line(predicted, real)(imagined), low, high))
    return RateEstimate(value, float(low), float(high))


def _line(x: np.ndarray, y: np.ndarray) -> Callable[[float], float]:
    """Return the line of least squares through points, a constant if all x are equal."""
    spread = float(((x - x.mean()) ** 2).sum())
    slope = float(((x - x.mean()) * (y - y.mean())).sum()) / spread if spread else 0.0
    return lambda value: float(y.mean() + slope * (value - x.mean()))
