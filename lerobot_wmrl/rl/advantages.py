"""Generalised advantage estimation. T time, B environments."""

import torch
from torch import Tensor


def generalised_advantages(
    reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, truncated: Tensor,
    gamma: float, gae_lambda: float,
) -> Tensor:  # fmt: skip
    """Schulman et al. 2016, eq. 16: A_t = δ_t + γλ A_{t+1}, δ_t = r_t + γ V(o_{t+1}) − V(o_t). All (T, B).

    `next_value` is the value of the observation that the action led to, also at an episode's last step.
    Termination makes it 0; truncation keeps it: the episode was cut, its future was not. Neither lets the
    next episode's advantages through.
    """
    delta = reward + gamma * next_value * (~terminated).to(value.dtype) - value
    carry = gamma * gae_lambda * (~(terminated | truncated)).to(delta.dtype)
    advantages = torch.empty_like(delta)
    running = torch.zeros_like(delta[0])
    for step in reversed(range(len(delta))):
        running = delta[step] + carry[step] * running
        advantages[step] = running
    return advantages


def normalised(advantages: Tensor) -> Tensor:
    """Mean 0 and standard deviation 1 over all steps. (T, B) → (T, B)"""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)
