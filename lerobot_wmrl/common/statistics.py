"""Proportions, means and other ratios with their uncertainty, and samples."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.stats import binomtest, mannwhitneyu

RESAMPLES = 2000


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % score interval of a proportion (Wilson 1927); (0, 1) for n = 0."""
    if n == 0:
        return 0.0, 1.0
    interval = binomtest(successes, n).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class Proportion:
    """k successes of n, with Wilson's interval."""

    k: int
    n: int

    @classmethod
    def of(cls, outcomes: Sequence[bool] | np.ndarray) -> "Proportion":
        """Count the successes among outcomes. (n,)"""
        return cls(int(np.sum(outcomes)), len(outcomes))

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Proportion":
        """Return the proportion that `as_json` has written."""
        return cls(content["k"], content["n"])

    @property
    def share(self) -> float:
        return self.k / self.n if self.n else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        return wilson_interval(self.k, self.n)

    @property
    def whiskers(self) -> list[list[float]]:
        """Distances of the share to both ends of its interval, as matplotlib's errorbar takes them."""
        low, high = self.interval
        return [[self.share - low], [high - self.share]]

    def __str__(self) -> str:
        if not self.n:
            return "no episode"
        low, high = self.interval
        return f"{100 * self.share:.0f} % ({self.k} of {self.n}; {100 * low:.0f}–{100 * high:.0f} %)"

    def as_json(self) -> dict[str, float | int | list[float] | None]:
        """Return the proportion as JSON, with share and interval, which a reader need not compute."""
        return {
            "k": self.k,
            "n": self.n,
            "share": self.share if self.n else None,
            "wilson_95": list(self.interval),
        }


@dataclass(frozen=True)
class Estimate:
    """A mean, or another ratio of two sums, over n episodes, with its bootstrap 95 % interval."""

    value: float
    low: float
    high: float
    n: int

    @classmethod
    def mean(cls, values: np.ndarray) -> "Estimate":
        """Return the mean of one number an episode (E,); NaN where an episode has none."""
        known = np.isfinite(values)
        return cls.ratio(np.where(known, values, 0), known)

    @classmethod
    def ratio(cls, numerator: np.ndarray, denominator: np.ndarray) -> "Estimate":
        """Return Σ numerator / Σ denominator over the episodes, (E,) each. NaN if the latter sum is 0."""
        value, low, high = map(float, bootstrap_ratio(numerator, denominator))
        return cls(value, low, high, int((np.asarray(denominator) > 0).sum()))

    @property
    def interval(self) -> tuple[float, float] | None:
        """Its ends; None for a single episode, which says nothing of others."""
        return (self.low, self.high) if self.n > 1 else None

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "not measured"
        return f"{self.value:.3g} " + (
            f"({self.low:.3g} to {self.high:.3g})" if self.interval else "(1 episode)"
        )

    def as_json(self) -> dict[str, float | int | list[float] | None]:
        """Return the estimate as JSON; the value is None where there is no episode."""
        known = not math.isnan(self.value)
        return {
            "value": self.value if known else None,
            "bootstrap_95": list(self.interval) if known and self.interval else None,
            "episodes": self.n,
        }


def bootstrap_ratio(
    numerator: np.ndarray, denominator: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Σ numerator / Σ denominator over E episodes and its bootstrap 95 % interval (Efron 1979).

    Whole episodes are drawn, since the frames of one depend on each other. (E, …), (E, …) → value, low, high,
    each (…); NaN where the denominator is 0.
    """
    sums = [np.asarray(part, np.float64) for part in (numerator, denominator)]
    episodes = len(sums[0])
    if not episodes:
        nothing = np.full(sums[0].shape[1:], np.nan)
        return nothing, nothing, nothing
    drawn = np.random.default_rng(0).multinomial(episodes, np.full(episodes, 1 / episodes), RESAMPLES)
    with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns without any episode are NaN, as they should
        value = sums[0].sum(0) / sums[1].sum(0)
        resampled = np.tensordot(drawn, sums[0], 1) / np.tensordot(drawn, sums[1], 1)
        low, high = np.nanpercentile(resampled, (2.5, 97.5), axis=0)
    return value, low, high


@dataclass(frozen=True)
class PairedChange:
    """Two policies on the same starts: failures that became successes, and the reverse."""

    gained: int
    lost: int

    @classmethod
    def between(cls, before: Sequence[bool], after: Sequence[bool]) -> "PairedChange":
        """Compare the outcomes of the same episodes in the same order. ValueError if their number differs."""
        pairs = list(zip(before, after, strict=True))
        return cls(sum(b and not a for a, b in pairs), sum(a and not b for a, b in pairs))

    @property
    def p_value(self) -> float:
        """Two-sided p-value of no change at all: McNemar's test in its exact form."""
        changed = self.gained + self.lost
        return float(binomtest(self.gained, changed).pvalue) if changed else 1.0

    def as_json(self) -> dict[str, float | int]:
        return {"gained": self.gained, "lost": self.lost, "p_value": self.p_value}


@lru_cache(maxsize=4)
def drawn_counts(runs: int, starts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how often each resample draws each run and each start. (B, R) and (B, E) float64

    The same for every table of one shape, and drawn once, which takes most of an interval's time. They are
    whole numbers: sums of outcomes (0 and 1) are exact, and every machine rounds an interval's ends alike.
    """
    rng = np.random.default_rng(0)
    drawn = [
        rng.multinomial(count, np.full(count, 1 / count), RESAMPLES).astype(np.float64)
        for count in (runs, starts)
    ]
    for counts in drawn:
        counts.setflags(write=False)
    return drawn[0], drawn[1]


@dataclass(frozen=True)
class RunsMean:
    """The mean over R runs on the same E starts, with a 95 % interval over both."""

    mean: float
    low: float
    high: float

    @classmethod
    def over(cls, values: Sequence[Sequence[float]]) -> "RunsMean":
        """Average one number a run and start, (R, E): an outcome, or the difference of two.

        The bootstrap draws runs and starts, each with replacement (pigeonhole bootstrap, Owen 2007). With
        one run the interval is over starts alone; with few it is only roughly right.
        """
        table = np.asarray(values, np.float64)
        runs, starts = table.shape
        drawn_runs, drawn_starts = drawn_counts(runs, starts)
        means = np.einsum("be,be->b", drawn_runs @ table, drawn_starts) / table.size
        low, high = np.percentile(means, (2.5, 97.5))
        return cls(float(table.mean()), float(low), float(high))


def evenly_spaced(count: int, limit: int) -> np.ndarray:
    """Return at most `limit` of the indices below `count`, the first and the last among them. (N,) int64"""
    return np.linspace(0, count - 1, min(count, limit)).round().astype(int)


def roc_auc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Return the area under the ROC curve: how often a positive scores higher than a negative.

    0.5 is chance; NaN without both.

    Args:
        scores: (N,).
        positive: (N,) bool.
    """
    if positive.all() or not positive.any():
        return math.nan
    above = mannwhitneyu(scores[positive], scores[~positive]).statistic
    return float(above / (positive.sum() * (~positive).sum()))
