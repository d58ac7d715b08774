"""From success counted in a world model to success in reality, with an interval.

A world model takes some failures for successes and misses some successes. Labelled rollouts that are replayed
in it say how often. So the success rate in imagination can be corrected, as the prevalence of an illness is
by what is known of the test for it. That supposes that the world model errs about the judged policy as it
does about the rollouts; policies whose real success is known, the references, show how far that holds.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy.stats import norm

from lerobot_wmrl.common.statistics import Proportion


class Recognition(NamedTuple):
    """How a world model calls labelled episodes: `recall` of the successes it calls successes, and of the
    failures it does so with `false_positives`."""

    recall: Proportion
    false_positives: Proportion

    @property
    def difference(self) -> float:
        """How much more often a success is called one than a failure (Youden's index): 1 is perfect, 0 is
        chance; NaN without both."""
        return self.recall.share - self.false_positives.share


class RateEstimate(NamedTuple):
    """A success rate with the interval that shall contain it."""

    value: float
    low: float
    high: float

    def within(self, margin: float) -> "RateEstimate":
        """Return the same value with the interval of this margin on both sides."""
        return RateEstimate(self.value, max(0.0, self.value - margin), min(1.0, self.value + margin))

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f} %)"


def corrected_rate(imagined: Proportion, recognition: Recognition, coverage: float) -> RateEstimate:
    """Correct a success rate for what the world model takes for a success (Rogan and Gladen 1978).

    The interval takes into account that all three rates are estimates (Lang and Reiczigel 2014). Rates are
    cut off at 0 and 1.

    Args:
        imagined: episodes that succeed in the world model.
        recognition: of labelled rollouts.
        coverage: share of such intervals that contain the real rate.

    Raises:
        ValueError: the world model calls failures successes at least as often as successes.
    """
    z = float(norm.ppf((1 + coverage) / 2))
    recall = _with_one_more(recognition.recall)
    specificity = 1 - _with_one_more(recognition.false_positives)
    difference = recall + specificity - 1
    if not recognition.difference > 0 or difference <= 0:
        raise ValueError("the world model does not tell successes from failures: nothing can be corrected")
    value = (imagined.share - recognition.false_positives.share) / recognition.difference
    n = imagined.n + z * z
    seen = (imagined.k + z * z / 2) / n
    centre = (seen + specificity - 1) / difference
    successes, failures = recognition.recall.n + 2, recognition.false_positives.n + 2
    of_recall = recall * (1 - recall) / successes
    of_specificity = specificity * (1 - specificity) / failures
    shift = 2 * z * z * (centre * of_recall - (1 - centre) * of_specificity)
    variance = seen * (1 - seen) / n + centre**2 * of_recall + (1 - centre) ** 2 * of_specificity
    half = z * math.sqrt(max(0.0, variance)) / difference
    low, high = centre + shift - half, centre + shift + half
    value = min(1.0, max(0.0, value))
    return RateEstimate(value, max(0.0, min(value, low)), min(1.0, max(value, high)))


def _with_one_more(rate: Proportion) -> float:
    """Return the share with one success and one failure more (Agresti and Coull 1998)."""
    return (rate.k + 1) / (rate.n + 2)


def conformal_margin(errors: Sequence[float], coverage: float) -> float:
    """Return the margin that contains another error of the same kind with a probability of `coverage`.

    Split conformal prediction (Lei et al. 2018): it holds whatever the errors' distribution, if the next one
    is exchangeable with them. Infinite if there are too few errors: 9 are needed for 0.9, 19 for 0.95.
    """
    rank = math.ceil((len(errors) + 1) * coverage)
    return sorted(map(abs, errors))[rank - 1] if rank <= len(errors) else math.inf
