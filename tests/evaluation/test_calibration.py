"""Imagined success corrected for what a world model takes for a success."""

import math

import numpy as np
import pytest

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.calibration import Confusion, calibrated_rate, corrected_rate

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


LINE = [(0.1 * place, 0.2 + 0.5 * 0.1 * place) for place in range(1, 10)]
"""Nine references on the line 0.2 + x / 2."""


def test_references_on_a_line_give_its_value_without_doubt():
    assert calibrated_rate(0.5, LINE, 0.9) == pytest.approx((0.45, 0.45, 0.45))
    assert calibrated_rate(1.0, [(0.5, 0.3)] * 9, 0.9) == pytest.approx((0.3, 0.3, 0.3)), "no slope is known"


def test_an_interval_of_90_percent_needs_nine_references():
    assert calibrated_rate(0.5, LINE[:8], 0.9) is None
    assert calibrated_rate(0.5, LINE[:4], 0.8) is not None
    assert calibrated_rate(0.5, LINE[:2], 0.5) is None
    assert calibrated_rate(0.5, [], 0.5) is None


def test_the_interval_is_jackknife_plus():
    """Each reference's error is by the line through all others (numpy's), and so is its prediction."""
    rng = np.random.default_rng(0)
    x, y = rng.random(20), rng.random(20)
    found = calibrated_rate(0.3, list(zip(x, y, strict=True)), 0.9)
    lines = [np.polyfit(np.delete(x, i), np.delete(y, i), 1) for i in range(20)]
    errors = [abs(y[i] - np.polyval(line, x[i])) for i, line in enumerate(lines)]
    values = [np.polyval(line, 0.3) for line in lines]
    low = sorted(value - error for value, error in zip(values, errors, strict=True))[1]  # ⌊21 · 0.1⌋ = 2nd
    high = sorted(value + error for value, error in zip(values, errors, strict=True))[18]  # ⌈21 · 0.9⌉ = 19th
    assert found == pytest.approx((np.polyval(np.polyfit(x, y, 1), 0.3), low, high))


def test_jackknife_intervals_contain_the_next_rate_often_enough():
    """1,500 draws of twelve references; the standard error of the share is 0.008."""
    rng, inside = np.random.default_rng(0), 0
    for _ in range(1500):
        seen = rng.random(13)
        real = 0.1 + 0.7 * seen + 0.1 * rng.standard_t(3, 13)
        found = calibrated_rate(seen[-1], list(zip(seen[:-1], real[:-1], strict=True)), 0.9)
        inside += found.low <= real[-1] <= found.high
    assert 0.87 < inside / 1500 < 0.97
