"""Advantages against an independent sum, and the two ways an episode can end."""

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.rl.grpo import group_advantages
from lerobot_wmrl.rl.ppo import generalised_advantages, normalised

GAMMA, LAMBDA = 0.97, 0.95
STEPS, ENVS = 17, 5


def random_rollout(seed: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randn(3, STEPS, ENVS, generator=generator, dtype=torch.float64)
    ends = torch.rand(STEPS, ENVS, generator=generator)
    return {
        "reward": numbers[0],
        "value": numbers[1],
        "next_value": numbers[2],
        "terminated": ends < 0.1,
        "truncated": (ends >= 0.1) & (ends < 0.2),
    }


def advantage_by_sums(rollout: dict[str, np.ndarray], start: int, env: int) -> float:
    """The definition: Σ_l (γλ)^l δ_{t+l}, up to and with the step that ends the episode."""
    total = 0.0
    for ahead, step in enumerate(range(start, STEPS)):
        alive = 0.0 if rollout["terminated"][step, env] else 1.0
        bootstrap = GAMMA * alive * rollout["next_value"][step, env]
        delta = rollout["reward"][step, env] + bootstrap - rollout["value"][step, env]
        total += (GAMMA * LAMBDA) ** ahead * delta
        if rollout["terminated"][step, env] or rollout["truncated"][step, env]:
            break
    return total


def test_advantages_equal_the_definition() -> None:
    rollout = random_rollout(0)
    computed = generalised_advantages(**rollout, gamma=GAMMA, gae_lambda=LAMBDA).numpy()
    arrays = {name: tensor.numpy() for name, tensor in rollout.items()}
    expected = [[advantage_by_sums(arrays, step, env) for env in range(ENVS)] for step in range(STEPS)]
    assert np.abs(computed - np.array(expected)).max() < 1e-10


def test_truncation_keeps_the_future_and_termination_does_not() -> None:
    flags = torch.tensor([[True, False]])
    zero = torch.zeros(1, 2)
    advantages = generalised_advantages(zero, zero, torch.full((1, 2), 2.0), flags, ~flags, GAMMA, LAMBDA)
    assert advantages.tolist() == [[0.0, torch.tensor(GAMMA).mul(2).item()]]


def test_nothing_leaks_from_the_next_episode() -> None:
    rollout = random_rollout(1)
    rollout["truncated"][8], rollout["terminated"][8] = True, False
    before = generalised_advantages(**rollout, gamma=GAMMA, gae_lambda=LAMBDA)
    rollout["reward"][9:] += 100.0
    rollout["value"][9:] -= 100.0
    after = generalised_advantages(**rollout, gamma=GAMMA, gae_lambda=LAMBDA)
    assert torch.equal(before[:9], after[:9])
    assert (before[9:] != after[9:]).all()


def test_normalised_advantages() -> None:
    given, chosen = torch.randn(40, 8) * 7 + 3, torch.rand(40, 8) < 0.7
    given[~chosen] = 1e6
    advantages = normalised(given, chosen)[chosen]
    assert advantages.mean().abs() < 1e-5
    assert abs(advantages.std().item() - 1) < 1e-4


def test_a_single_decision_is_as_good_as_the_average() -> None:
    assert normalised(torch.tensor([[7.0]]), torch.tensor([[True]])).item() == 0.0


def test_group_advantages_are_of_the_group_not_of_the_batch() -> None:
    """An easy start's worst episode is below 0, a hard start's best above, whatever the other group did."""
    returns = torch.tensor([[0.9, 1.0, 1.1, 1.0], [0.0, 0.2, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
    advantages, signal = group_advantages(returns, 0.05)
    assert signal.tolist() == [True, True, False]
    assert advantages.mean(dim=1).abs().max() < 1e-6
    assert torch.allclose(advantages[:2].std(dim=1, correction=0), torch.ones(2))
    assert advantages[0, 0] < 0 < advantages[1, 1]
    assert (advantages[2] == 0).all()
    by_hand = (returns[0] - 1) / returns[0].std(correction=0)
    assert torch.allclose(advantages[0], by_hand, atol=1e-5)
