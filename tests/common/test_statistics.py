import math
from statistics import NormalDist

import numpy as np
import pytest

from lerobot_wmrl.common.statistics import (
    Estimate,
    PairedChange,
    Proportion,
    bootstrap_ratio,
    wilson_interval,
)

Z_95 = NormalDist().inv_cdf(0.975)


@pytest.mark.parametrize(("k", "n"), [(0, 20), (0, 64), (7, 20), (53, 100), (80, 80), (100, 100)])
def test_wilson_bounds_are_where_the_score_test_is_exactly_significant(k: int, n: int) -> None:
    """The definition: |p̂ − p| = z·sqrt(p(1−p)/n) at both bounds p (or the bound is 0 or 1 when k is)."""
    for bound in wilson_interval(k, n):
        if 1e-12 < bound < 1 - 1e-12:
            assert abs(k / n - bound) == pytest.approx(Z_95 * math.sqrt(bound * (1 - bound) / n))
    low, high = wilson_interval(k, n)
    assert low <= k / n <= high
    (below,), (above,) = Proportion(k, n).whiskers
    assert (k / n - below, k / n + above) == pytest.approx((low, high))
    assert min(below, above) >= 0, "which matplotlib refuses"


def test_no_episode_is_no_number() -> None:
    nothing = Proportion(0, 0)
    assert nothing.interval == (0.0, 1.0)
    assert nothing.as_json()["share"] is None
    assert str(nothing) == "no episode"


def test_text_carries_share_count_and_interval() -> None:
    assert str(Proportion(50, 100)) == "50 % (50 of 100; 40–60 %)"


def test_a_change_counts_only_starts_whose_outcome_differs() -> None:
    before = [True, True, False, False, False, True]
    after = [True, False, True, True, False, True]
    change = PairedChange.between(before, after)
    assert (change.gained, change.lost) == (2, 1)
    with pytest.raises(ValueError, match="shorter"):
        PairedChange.between(before, after[:-1])


def test_paired_p_value_is_that_of_a_fair_coin() -> None:
    assert PairedChange(0, 0).p_value == 1.0
    assert PairedChange(6, 0).p_value == pytest.approx(2 / 2**6)
    assert PairedChange(6, 1).p_value == pytest.approx(2 * (1 + 7) / 2**7)
    assert PairedChange(1, 6).p_value == PairedChange(6, 1).p_value


def test_the_bootstrap_of_a_mean_is_its_normal_interval() -> None:
    values = np.random.default_rng(0).normal(3, 2, 400)
    estimate = Estimate.mean(np.append(values, np.nan))
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.n == 400
    assert estimate.high - estimate.low == pytest.approx(2 * Z_95 * values.std() / math.sqrt(400), rel=0.1)


def test_the_bootstrap_draws_whole_episodes() -> None:
    """The frames of an episode are all right or all wrong: 2000 frames are only twenty draws."""
    right = np.repeat([[0], [100]], 10, axis=0)[:, 0]
    estimate = Estimate.ratio(right, np.full(20, 100))
    assert estimate.value == 0.5
    assert estimate.high - estimate.low == pytest.approx(2 * Z_95 * 0.5 / math.sqrt(20), rel=0.2)
    assert estimate == Estimate.ratio(right, np.full(20, 100))


def test_bootstraps_by_column_are_those_of_each_column() -> None:
    values = np.random.default_rng(0).random((30, 3))
    low = bootstrap_ratio(values, np.ones_like(values))[1]
    assert low[1] == pytest.approx(Estimate.mean(values[:, 1]).low)


def test_a_single_episode_has_no_interval() -> None:
    alone = Estimate.mean(np.array([0.5, np.nan]))
    assert alone.as_json() == {"value": 0.5, "bootstrap_95": None, "episodes": 1}
    assert str(alone) == "0.5 (1 episode)"


def test_a_mean_of_nothing_is_no_number() -> None:
    for nothing in (np.array([]), np.array([np.nan, np.nan])):
        assert Estimate.mean(nothing).as_json() == {"value": None, "bootstrap_95": None, "episodes": 0}
        assert str(Estimate.mean(nothing)) == "not measured"
