"""The general reward, in imagination and in the simulator."""

from itertools import pairwise

import pytest
import torch

from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import (
    RuleBasedReward,
    consecutive_count,
    default_discount,
    general_reward,
    is_done,
)
from lerobot_wmrl.rewards.modeling_rewards import GeneralRewardModel
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig

GAMMA = 0.97
HORIZON = 40


def test_a_frame_is_done_from_the_threshold_on():
    logits = torch.tensor([-0.1, 0.0, 0.1])
    assert is_done(logits, 0.5).tolist() == [False, True, True]


def test_the_potential_form_pays_nothing_for_lingering_and_for_going_in_circles():
    path = torch.tensor([0.2, 0.5, 0.9, 0.5, 0.2])
    zero = torch.zeros(4)
    earned = general_reward(zero, path[1:], path[:-1], alpha=0.0, form="potential", gamma=1.0)
    assert earned.sum().item() == pytest.approx(0, abs=1e-6)


def test_success_is_worth_more_than_any_lingering_with_the_default_weights():
    reward = GeneralRewardModel(GeneralConfig(device="cpu", gamma=GAMMA))
    still = torch.ones(1)
    linger = reward.compute_reward({"success": 0 * still, "similarity": still, "previous.similarity": still})
    finish = reward.compute_reward({"success": still, "similarity": still, "previous.similarity": still})
    assert finish.item() > 40 * linger.item()


def test_done_must_fire_in_a_row():
    count = torch.zeros(1, dtype=torch.long)
    runs = [
        (count := consecutive_count(count, torch.tensor([fired == 1]))).item() for fired in (1, 1, 0, 1, 1, 1)
    ]
    assert runs == [1, 2, 0, 1, 2, 3]


@pytest.mark.parametrize(("longest", "discount"), [(1, 0.3), (40, 0.97), (110, 0.989), (5000, 0.999)])
def test_the_discount_leaves_a_success_in_the_last_step_its_worth(longest: int, discount: float) -> None:
    """PPO's, and that of progress, unless they are given."""
    assert PPOConfig().discount(longest) == default_discount(longest) == discount
    assert PPOConfig(gamma=0.9).discount(longest) == 0.9
    progress = RuleBasedReward(alpha=0.0).step_reward(0.0, 1.0, 0.0, longest)
    assert progress == pytest.approx(discount)


def test_alone_the_potential_form_needs_a_discount() -> None:
    one = torch.ones(1)
    batch = {"success": one, "similarity": one, "previous.similarity": one}
    with pytest.raises(ValueError, match=r"^gamma=None: .* give the discount"):
        GeneralRewardModel(GeneralConfig(device="cpu")).compute_reward(batch)


def test_bad_settings_name_the_field():
    with pytest.raises(ValueError, match=r"^form=relative: choose"):
        GeneralConfig(device="cpu", form="relative")
    with pytest.raises(ValueError, match=r"alpha=1\.5"):
        GeneralConfig(device="cpu", alpha=1.5)
    with pytest.raises(ValueError, match=r"gamma=97: must be a discount"):
        GeneralConfig(device="cpu", gamma=97)


def returned(reward: RuleBasedReward, progress: list[float], succeeds: bool) -> float:
    """Discounted sum along an episode."""
    steps = enumerate(pairwise(progress))
    last = len(progress) - 2
    return sum(
        GAMMA**t * reward.step_reward(float(succeeds and t == last), now, before, HORIZON)
        for t, (before, now) in steps
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
