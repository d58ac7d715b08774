"""From success counted in a world model to success in reality, with an interval.

A world model takes some failures for successes and misses some successes. Labelled rollouts that are replayed
in it say how often, and by that the success rate in imagination can be corrected. This supposes that the
world model errs about a policy as it does about the rollouts. Policies whose real success is known, the
references, show how far that holds.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy.stats import norm

from lerobot_wmrl.common.statistics import Proportion


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

    def with_margin(self, margin: float) -> "RateEstimate":
        """Return the same value, within 0 and 1, with this margin on both sides."""
        value = self.clipped().value
        return RateEstimate(value, value - margin, value + margin).clipped()

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


def conformal_margin(errors: Sequence[float], coverage: float) -> float:
    """Return the margin that contains another error of the same kind with a probability of `coverage`.

    Split conformal prediction (Lei et al. 2018). It holds whatever the errors' distribution, if the next one
    is exchangeable with them, and over the draws of all of them, not given these. Infinite if there are too
    few errors: 0.9 needs 9, 0.95 needs 19.
    """
    rank = math.ceil((len(errors) + 1) * coverage)
    return sorted(map(abs, errors))[rank - 1] if rank <= len(errors) else math.inf
