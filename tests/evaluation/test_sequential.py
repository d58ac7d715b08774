"""The sequential test keeps its error rate however often it is looked at, and finds real differences."""

import numpy as np
import pytest
from scipy.integrate import quad

from lerobot_wmrl.common.statistics import PairedChange
from lerobot_wmrl.evaluation.comparison import Comparison, Episode
from lerobot_wmrl.evaluation.sequential import SequentialTest, log_e_value

ALPHA = 0.05
COMPARISONS, STARTS = 2000, 200


def outcomes(rng: np.random.Generator, rates: tuple[float, ...], starts: int = STARTS) -> np.ndarray:
    """Outcomes (policies, starts) of policies that find the same starts hard: half of the luck is shared."""
    shared = rng.random(starts) < 0.5
    luck = np.where(shared, rng.random(starts), rng.random((len(rates), starts)))
    return luck < np.array(rates)[:, None]


@pytest.mark.parametrize(("gained", "lost"), [(0, 0), (3, 0), (2, 5), (30, 11)])
def test_the_e_value_is_the_average_likelihood_ratio_over_all_biases(gained: int, lost: int) -> None:
    average, _ = quad(lambda bias: (2 * bias) ** gained * (2 - 2 * bias) ** lost, 0, 1)
    assert np.exp(log_e_value(np.array([gained]), np.array([lost]))) == pytest.approx(average)


def test_the_e_value_is_a_martingale_if_gains_and_losses_are_equally_likely() -> None:
    gained, lost = (grid.ravel() for grid in np.meshgrid(np.arange(30), np.arange(30)))
    following = (log_e_value(gained + 1, lost), log_e_value(gained, lost + 1))
    assert np.mean(np.exp(following), 0) == pytest.approx(np.exp(log_e_value(gained, lost)))


def test_the_p_value_is_the_smallest_so_far_and_swaps_its_sign_with_the_policies() -> None:
    before, after = [False] * 10, [True] * 10
    assert SequentialTest.between(before, after) == SequentialTest(pytest.approx(11 / 2**10), 1)
    assert SequentialTest.between(after, before) == SequentialTest(pytest.approx(11 / 2**10), -1)
    later = SequentialTest.between([*before, *after], [*after, *before])
    assert later == SequentialTest(pytest.approx(11 / 2**10), 1)
    assert SequentialTest.between([], []) == SequentialTest.between([True], [True]) == SequentialTest(1.0, 0)
    with pytest.raises(ValueError, match="shorter"):
        SequentialTest.between(before, after[:-1])


@pytest.mark.parametrize("rate", [0.5, 0.9])
def test_equal_policies_are_rarely_called_different_though_every_start_is_looked_at(rate: float) -> None:
    rng = np.random.default_rng(0)
    false = sum(
        SequentialTest.between(*outcomes(rng, (rate, rate))).p_value <= ALPHA for _ in range(COMPARISONS)
    )
    assert 0 < false / COMPARISONS <= ALPHA


def test_mcnemars_test_would_call_equal_policies_different_too_often() -> None:
    """After blocks of ten starts: this is why there is a sequential test."""
    rng, false = np.random.default_rng(0), 0
    for _ in range(100):
        both = outcomes(rng, (0.5, 0.5))
        looks = (PairedChange.between(*both[:, :n]).p_value for n in range(10, STARTS + 1, 10))
        false += any(p_value <= ALPHA for p_value in looks)
    assert false / 100 > 3 * ALPHA


def test_a_real_difference_is_found_and_its_direction_is_right() -> None:
    rng = np.random.default_rng(1)
    tests = [SequentialTest.between(*outcomes(rng, (0.6, 0.8))) for _ in range(COMPARISONS)]
    decided = [test.sign for test in tests if test.p_value <= ALPHA]
    assert len(decided) / COMPARISONS > 0.95
    assert np.mean(np.array(decided) == 1) > 0.999


def test_several_pairs_share_the_error_rate() -> None:
    """Three equal policies, all against all: a comparison is wrong if one of its three pairs is."""
    rng, false = np.random.default_rng(2), 0
    for _ in range(500):
        comparison = Comparison("abc", STARTS, "all", ALPHA)
        for seed, row in enumerate(outcomes(rng, (0.5,) * 3).T.tolist()):
            comparison.episodes.append(Episode("suite", 0, seed, row))
        false += any(pair.better for pair in comparison.pairs())
    assert false / 500 <= ALPHA
