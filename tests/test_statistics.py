import math

import pytest

from lerobot_wmrl.statistics import Z_95, PairedChange, Proportion, wilson_interval


@pytest.mark.parametrize(("k", "n"), [(0, 20), (7, 20), (53, 100), (100, 100)])
def test_wilson_bounds_are_where_the_score_test_is_exactly_significant(k: int, n: int) -> None:
    """The definition: |p̂ − p| = z·sqrt(p(1−p)/n) at both bounds p (or the bound is 0 or 1 when k is)."""
    for bound in wilson_interval(k, n):
        if 1e-12 < bound < 1 - 1e-12:
            assert abs(k / n - bound) == pytest.approx(Z_95 * math.sqrt(bound * (1 - bound) / n))
    low, high = wilson_interval(k, n)
    assert low <= k / n <= high


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
