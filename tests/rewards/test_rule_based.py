"""What the simulator pays for success and progress."""

from itertools import pairwise

import pytest

from lerobot_wmrl.rewards.rule_based import RuleBasedReward

GAMMA = 0.97
HORIZON = 40


def returned(reward: RuleBasedReward, progress: list[float], succeeds: bool) -> float:
    """Discounted sum along an episode."""
    steps = enumerate(pairwise(progress))
    last = len(progress) - 2
    return sum(
        GAMMA**t * reward.of_step(float(succeeds and t == last), now, before) for t, (before, now) in steps
    )


def test_to_succeed_pays_more_than_to_linger_just_before_it() -> None:
    reward, approach = RuleBasedReward(), [0.2, 0.5, 0.9]
    assert returned(reward, [*approach, 1.0], True) > 2 * returned(
        reward, [*approach, *[0.9] * HORIZON], False
    )


def test_the_potential_form_pays_for_the_way_not_for_its_length() -> None:
    reward = RuleBasedReward(alpha=0.0, gamma=1.0)
    slow = [0.1, 0.2, 0.15, 0.3, 0.8]
    assert returned(reward, slow, False) == pytest.approx(
        sum(GAMMA**t * (b - a) for t, (a, b) in enumerate(pairwise(slow)))
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"form": "sum"}, "form=sum"), ({"alpha": 2.0}, "alpha=2.0"), ({"gamma": -1.0}, "gamma=-1.0")],
)
def test_there_is_no_other_reward(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RuleBasedReward(**fields)
