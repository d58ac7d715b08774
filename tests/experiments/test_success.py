"""What lerobot-eval left becomes results."""

import math
from statistics import NormalDist

import numpy as np
import pytest

from experiments.steps.success import MeanChange


def test_the_interval_of_several_runs_counts_a_start_once() -> None:
    """Three copies of a run say no more than one: its interval is that of the mean over its starts."""
    rng = np.random.default_rng(0)
    before, after = rng.random(200) < 0.5, rng.random(200) < 0.7
    change = after.astype(float) - before
    once = MeanChange.over_runs([before], [after])
    thrice = MeanChange.over_runs([before] * 3, [after] * 3)
    assert (thrice.low, thrice.high) == (once.low, once.high)
    assert once.mean == pytest.approx(change.mean())
    assert once.high - once.low == pytest.approx(
        2 * NormalDist().inv_cdf(0.975) * change.std() / math.sqrt(200), rel=0.1
    )


def test_runs_on_different_starts_are_not_pooled() -> None:
    with pytest.raises(ValueError, match="different numbers of starts"):
        MeanChange.over_runs([[True], [True, False]], [[True], [True, False]])


def test_runs_that_change_nothing_change_nothing() -> None:
    assert MeanChange.over_runs([[True, False]], [[True, False]]) == MeanChange(0.0, 0.0, 0.0, 1, 2)
