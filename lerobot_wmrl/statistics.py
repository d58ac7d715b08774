"""Proportions with their uncertainty."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import binomtest

Z_95 = 1.959963984540054


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a proportion; (0, 1) for n = 0 (Wilson 1927)."""
    if n == 0:
        return 0.0, 1.0
    share, z2 = successes / n, Z_95**2
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 / (1 + z2 / n) * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Proportion:
    """k of n."""

    k: int
    n: int

    @property
    def share(self) -> float:
        return self.k / self.n if self.n else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        return wilson_interval(self.k, self.n)

    def __str__(self) -> str:
        if not self.n:
            return "no episode"
        low, high = self.interval
        return f"{100 * self.share:.0f} % ({self.k} of {self.n}; {100 * low:.0f}–{100 * high:.0f} %)"

    def as_json(self) -> dict[str, float | int | list[float] | None]:
        """Share and interval included, so that a reader of the file need not compute them."""
        return {
            "k": self.k,
            "n": self.n,
            "share": self.share if self.n else None,
            "wilson_95": list(self.interval),
        }


@dataclass(frozen=True)
class PairedChange:
    """Two policies on the same starts: failures that became successes, and the reverse."""

    gained: int
    lost: int

    @classmethod
    def between(cls, before: Sequence[bool], after: Sequence[bool]) -> "PairedChange":
        """From the outcomes of the same episodes in the same order. ValueError if their number differs."""
        pairs = list(zip(before, after, strict=True))
        return cls(sum(b and not a for a, b in pairs), sum(a and not b for a, b in pairs))

    @property
    def p_value(self) -> float:
        """Of no change at all, two-sided: McNemar's test in its exact form."""
        changed = self.gained + self.lost
        return float(binomtest(self.gained, changed).pvalue) if changed else 1.0

    def as_json(self) -> dict[str, float | int]:
        return {"gained": self.gained, "lost": self.lost, "p_value": self.p_value}
