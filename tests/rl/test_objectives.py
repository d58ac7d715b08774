"""The losses against formulas written down anew, as CleanRL and TorchRL have them, in float64."""

import numpy as np
import pytest
import torch
from torch import Tensor

from lerobot_wmrl.rl.objective import clipped_objective, kl_estimate, log_ratios, outside_clip
from lerobot_wmrl.rl.ppo import generalised_advantages, value_loss

STEPS, ENVS, PARTS = 23, 6, 4


@pytest.fixture
def numbers() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def draw(numbers: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=numbers, dtype=torch.float64)


def test_advantages_equal_cleanrl_s(numbers: torch.Generator) -> None:
    """Its loop in numpy: `nextnonterminal` belongs to the step after, dones end an episode, no truncation."""
    reward, value = draw(numbers, STEPS, ENVS), draw(numbers, STEPS + 1, ENVS)
    done = torch.rand(STEPS + 1, ENVS, generator=numbers) < 0.2
    expected, last = np.zeros((STEPS, ENVS)), np.zeros(ENVS)
    for step in reversed(range(STEPS)):
        alive = 1.0 - done[step + 1].double().numpy()
        delta = reward[step].numpy() + 0.99 * value[step + 1].numpy() * alive - value[step].numpy()
        last = delta + 0.99 * 0.95 * alive * last
        expected[step] = last
    found = generalised_advantages(
        reward, value[:-1], value[1:], done[1:], torch.zeros_like(done[1:]), 0.99, 0.95
    )
    assert np.abs(found.numpy() - expected).max() < 1e-10


def test_advantages_equal_torchrl_s(numbers: torch.Generator) -> None:
    """Its `generalized_advantage_estimate`: `done` cuts the sum, `terminated` alone cuts the bootstrap."""
    reward, value, following = (draw(numbers, STEPS, ENVS) for _ in range(3))
    terminated = torch.rand(STEPS, ENVS, generator=numbers) < 0.1
    done = terminated | (torch.rand(STEPS, ENVS, generator=numbers) < 0.1)
    not_done, not_terminated = (~done).double(), (~terminated).double()
    expected, previous = torch.empty_like(reward), torch.zeros(ENVS, dtype=torch.float64)
    for step in reversed(range(STEPS)):
        delta = reward[step] + 0.97 * following[step] * not_terminated[step] - value[step]
        previous = expected[step] = delta + 0.97 * 0.9 * not_done[step] * previous
    found = generalised_advantages(reward, value, following, terminated, done & ~terminated, 0.97, 0.9)
    assert (found - expected).abs().max() < 1e-10


def test_the_policy_loss_equals_cleanrl_s_and_torchrl_s(numbers: torch.Generator) -> None:
    new, old, advantage = draw(numbers, 200, PARTS), draw(numbers, 200, PARTS), draw(numbers, 200)
    found = clipped_objective(log_ratios(new - old, "action"), advantage, 0.2, 0.2).mean()
    ratio = (new.sum(1) - old.sum(1)).exp()
    cleanrl = torch.max(-advantage * ratio, -advantage * torch.clamp(ratio, 1 - 0.2, 1 + 0.2)).mean()
    log_weight = (new.sum(1) - old.sum(1))[:, None]
    clipped = log_weight.clamp(np.log1p(-0.2), np.log1p(0.2))
    gains = torch.stack([log_weight.exp() * advantage[:, None], clipped.exp() * advantage[:, None]], -1)
    torchrl = -gains.min(dim=-1).values.mean()
    assert abs(found - cleanrl) < 1e-10
    assert abs(found - torchrl) < 1e-10


def test_a_ratio_for_each_token_is_clipped_on_its_own(numbers: torch.Generator) -> None:
    new, old, advantage = draw(numbers, 50, PARTS), draw(numbers, 50, PARTS), draw(numbers, 50)
    found = clipped_objective(log_ratios(new - old, "token"), advantage, 0.2, 0.28)
    for step in range(50):
        for part in range(PARTS):
            ratio = np.exp(new[step, part].item() - old[step, part].item())
            gain = min(ratio * advantage[step].item(), np.clip(ratio, 0.8, 1.28) * advantage[step].item())
            assert abs(found[step, part].item() + gain) < 1e-10
    outside = outside_clip(new - old, 0.2, 0.28)
    ratios = (new - old).exp()
    assert torch.equal(outside == 1, (ratios < 0.8) | (ratios > 1.28))
    assert 0 < outside.mean() < 1


def test_the_value_loss_equals_torchrl_s(numbers: torch.Generator) -> None:
    value, target = (draw(numbers, 200) for _ in range(2))
    error = (value - target).abs()
    smooth_l1 = torch.where(error < 1, 0.5 * error**2, error - 0.5).mean()
    assert abs(value_loss(value, target).mean() - smooth_l1) < 1e-10


def test_kl_equals_cleanrl_s(numbers: torch.Generator) -> None:
    new, old = draw(numbers, 100, PARTS), draw(numbers, 100, PARTS)
    log_ratio = new.sum(1) - old.sum(1)
    assert abs(kl_estimate(old, new).mean() - ((log_ratio.exp() - 1) - log_ratio).mean()) < 1e-10
