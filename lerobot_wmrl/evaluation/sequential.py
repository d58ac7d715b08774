"""A sequential test of two policies on the same starts, valid however often it is looked at."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betaln


@dataclass(frozen=True)
class SequentialTest:
    """McNemar's test in a form that may be looked at after every start and may stop at any of them.

    If two policies are equally good, a start on which they differ is gained or lost as by a fair coin. The
    e-value compares a coin of unknown, uniformly distributed bias with a fair one. For equal policies it is a
    martingale with mean 1 (Robbins 1970), so the probability that it ever reaches 1/α is at most α (Ville
    1939). One over the largest e-value so far is a p-value at every time of stopping (Ramdas et al. 2023).

    Args:
        p_value: two-sided, of no difference.
        sign: 1 if there were more starts gained than lost where the e-value was largest, −1 if fewer, else 0.
    """

    p_value: float
    sign: int

    @classmethod
    def between(cls, before: Sequence[bool], after: Sequence[bool]) -> "SequentialTest":
        """Test the outcomes of the same starts in the order in which they ran. ValueError if their number
        differs."""
        pairs = np.array(list(zip(before, after, strict=True)), int).reshape(-1, 2)
        change = pairs[:, 1] - pairs[:, 0]
        gained, lost = np.cumsum(change > 0), np.cumsum(change < 0)
        evidence = log_e_value(gained, lost)
        if not evidence.size or evidence.max() <= 0:
            return cls(1.0, 0)
        largest = int(evidence.argmax())
        return cls(math.exp(-evidence[largest]), int(np.sign(gained[largest] - lost[largest])))


def log_e_value(gained: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Return log(2ⁿ / ((n + 1) · C(n, gained))) with n = gained + lost: the likelihood of a coin with uniform
    bias over that of a fair one. (E,), (E,) → (E,)"""
    evidence: np.ndarray = (gained + lost) * math.log(2) + betaln(gained + 1, lost + 1)
    return evidence
