"""Imagined success corrected for what a world model takes for a success."""

import math

import numpy as np
import pytest

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.calibration import RateEstimate, Recognition, conformal_margin, corrected_rate

PERFECT = Recognition(Proportion(10_000, 10_000), Proportion(0, 10_000))


def test_a_perfect_world_model_needs_no_correction():
    found = corrected_rate(Proportion(60, 100), PERFECT, 0.95)
    low, high = Proportion(60, 100).interval
    assert found.value == pytest.approx(0.6)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.002)  # Wilson's


def test_the_correction_is_rogan_and_gladens():
    """With 80 % recall and 20 % false positives 50 % seen are 50 % true, and 38 % seen are 30 %."""
    recognition = Recognition(Proportion(80, 100), Proportion(20, 100))
    assert corrected_rate(Proportion(50, 100), recognition, 0.9).value == pytest.approx(0.5)
    assert corrected_rate(Proportion(38, 100), recognition, 0.9).value == pytest.approx(0.3)


@pytest.mark.parametrize(("k", "value"), [(10, 0.0), (95, 1.0)])
def test_a_rate_beyond_what_the_world_model_can_see_is_cut_off_and_lies_in_its_interval(k, value):
    found = corrected_rate(Proportion(k, 100), Recognition(Proportion(80, 100), Proportion(20, 100)), 0.9)
    assert found.value == value
    assert 0 <= found.low <= found.value <= found.high <= 1
    assert found.high - found.low < 0.3


@pytest.mark.parametrize("coverage", [0.8, 0.95])
@pytest.mark.parametrize(
    ("real", "recall", "false_positive_rate", "counts"),
    [(0.3, 0.9, 0.1, (30, 60, 100)), (0.7, 0.8, 0.05, (60, 20, 200)), (0.95, 0.95, 0.3, (40, 40, 200))],
)
def test_intervals_contain_the_real_rate_as_often_as_they_say(
    coverage, real, recall, false_positive_rate, counts
):
    """All three rates are drawn 1,500 times; the standard error of the share is at most 0.011."""
    rng, (successes, failures, imagined) = np.random.default_rng(0), counts
    seen = real * recall + (1 - real) * false_positive_rate
    inside = 0
    for _ in range(1500):
        recognition = Recognition(
            Proportion(rng.binomial(successes, recall), successes),
            Proportion(rng.binomial(failures, false_positive_rate), failures),
        )
        found = corrected_rate(Proportion(rng.binomial(imagined, seen), imagined), recognition, coverage)
        inside += found.low <= real <= found.high
    assert coverage - 0.03 < inside / 1500


def test_few_labelled_rollouts_widen_the_interval():
    def width(n: int) -> float:
        recognition = Recognition(Proportion(9 * n // 10, n), Proportion(n // 10, n))
        found = corrected_rate(Proportion(50, 100), recognition, 0.9)
        return found.high - found.low

    assert width(10) > width(40) > width(1000)


@pytest.mark.parametrize(
    ("recall", "false_positives"), [((5, 10), (5, 10)), ((4, 10), (8, 10)), ((3, 3), (0, 0))]
)
def test_a_world_model_that_tells_nothing_is_refused(recall, false_positives):
    recognition = Recognition(Proportion(*recall), Proportion(*false_positives))
    with pytest.raises(ValueError, match="does not tell successes from failures"):
        corrected_rate(Proportion(5, 10), recognition, 0.9)


def test_a_conformal_margin_is_the_error_of_the_right_rank():
    errors = [0.01, -0.02, 0.03, -0.04, 0.05, 0.06, 0.07, 0.08, -0.09]
    assert conformal_margin(errors, 0.9) == 0.09  # the ⌈10 · 0.9⌉ = 9th smallest
    assert conformal_margin(errors, 0.8) == 0.08
    assert conformal_margin(errors[:8], 0.9) == math.inf
    assert conformal_margin([], 0.5) == math.inf


def test_a_conformal_margin_contains_the_next_error_often_enough():
    drawn = np.random.default_rng(0).standard_cauchy((4000, 20))
    inside = [abs(row[-1]) <= conformal_margin(row[:-1], 0.9) for row in drawn]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.015)


def test_an_interval_of_a_margin_stays_between_0_and_1():
    assert RateEstimate(0.9, 0.85, 0.95).within(0.2) == pytest.approx((0.9, 0.7, 1.0))
    assert RateEstimate(0.1, 0.05, 0.2).within(math.inf) == (0.1, 0.0, 1.0)
