"""Imagined success corrected for what a world model takes for a success."""

import math

import numpy as np
import pytest

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.calibration import Confusion, RateEstimate, conformal_margin, corrected_rate

PERFECT = Confusion(Proportion(10_000, 10_000), Proportion(0, 10_000))


def test_a_perfect_world_model_needs_no_correction():
    found = corrected_rate(Proportion(60, 100), PERFECT, 0.95)
    low, high = Proportion(60, 100).interval
    assert found.value == pytest.approx(0.6)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.002)  # Wilson's


def test_the_correction_is_rogan_and_gladens():
    """With 80 % recall and 20 % false positives 50 % seen are 50 % true, and 38 % seen are 30 %."""
    confusion = Confusion(Proportion(80, 100), Proportion(20, 100))
    assert corrected_rate(Proportion(50, 100), confusion, 0.9).value == pytest.approx(0.5)
    assert corrected_rate(Proportion(38, 100), confusion, 0.9).value == pytest.approx(0.3)


def test_the_interval_is_lang_and_reiczigels():
    """By hand, step by step, for 38 of 100 seen, recall 27 of 30, false positives 5 of 50, and z = 1.645."""
    z = 1.6448536269514722
    rate, recall, specificity = (38 + z**2 / 2) / (100 + z**2), 28 / 32, 46 / 52
    youden = recall + specificity - 1
    centre = (rate + specificity - 1) / youden
    variances = [
        rate * (1 - rate) / (100 + z**2),
        recall * (1 - recall) / 32,
        specificity * (1 - specificity) / 52,
    ]
    shift = 2 * z**2 * (centre * variances[1] - (1 - centre) * variances[2])
    half = z / youden * math.sqrt(variances[0] + centre**2 * variances[1] + (1 - centre) ** 2 * variances[2])
    found = corrected_rate(Proportion(38, 100), Confusion(Proportion(27, 30), Proportion(5, 50)), 0.9)
    assert found == pytest.approx((0.28 / 0.8, centre + shift - half, centre + shift + half))


def test_a_rate_that_no_real_one_explains_is_beyond_0_and_1_until_it_is_clipped():
    confusion = Confusion(Proportion(80, 100), Proportion(20, 100))
    low, high = (corrected_rate(Proportion(k, 200), confusion, 0.9) for k in (5, 195))
    assert low.high < 0
    assert high.low > 1
    assert low.clipped() == (0, 0, 0)
    assert high.clipped() == (1, 1, 1)
    near = corrected_rate(Proportion(35, 200), confusion, 0.9)
    assert near.low < near.value < 0 < near.high


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
        confusion = Confusion(
            Proportion(rng.binomial(successes, recall), successes),
            Proportion(rng.binomial(failures, false_positive_rate), failures),
        )
        found = corrected_rate(Proportion(rng.binomial(imagined, seen), imagined), confusion, coverage)
        inside += found.low <= real <= found.high
    assert coverage - 0.03 < inside / 1500 < coverage + 0.06


def test_few_labelled_rollouts_widen_the_interval():
    def width(n: int) -> float:
        confusion = Confusion(Proportion(9 * n // 10, n), Proportion(n // 10, n))
        found = corrected_rate(Proportion(50, 100), confusion, 0.9)
        return found.high - found.low

    assert width(10) > width(40) > width(1000)


@pytest.mark.parametrize(
    ("recall", "false_positives"), [((5, 10), (5, 10)), ((4, 10), (8, 10)), ((3, 3), (0, 0))]
)
def test_a_world_model_that_tells_nothing_is_refused(recall, false_positives):
    confusion = Confusion(Proportion(*recall), Proportion(*false_positives))
    with pytest.raises(ValueError, match="does not tell successes from failures"):
        corrected_rate(Proportion(5, 10), confusion, 0.9)


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
    assert RateEstimate(0.9, 0.85, 0.95).with_margin(0.2) == pytest.approx((0.9, 0.7, 1.0))
    assert RateEstimate(-0.1, -0.3, 0.2).with_margin(0.2) == (0.0, 0.0, 0.2)
