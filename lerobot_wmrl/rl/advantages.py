"""Advantages: generalised ones for PPO, a group's for GRPO. T time, B environments, G of a group."""

import torch
from torch import Tensor

from lerobot_wmrl.common.distributed import mean_and_variance


def generalised_advantages(
    reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, truncated: Tensor,
    gamma: float, gae_lambda: float, decided: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Schulman et al. 2016, eq. 16: A_t = δ_t + γλ A_{t+1}, δ_t = r_t + γ V(o_{t+1}) − V(o_t). All (T, B).

    `next_value` is the value of the observation that the action led to, also at an episode's last step.
    Termination makes it 0; truncation keeps it: the episode was cut, its future was not. Neither lets the
    next episode's advantages through.

    Where `decided` is False, the step before is continued without a decision: δ of a decision on n steps is
    Σ_{i<n} γ^i r_{t+i} + γ^n V(o_{t+n}) − V(o_t), its A is A_t, and other rows mean nothing.
    """
    alive = (~terminated).to(value.dtype)
    connected = (~(terminated | truncated)).to(value.dtype)
    advantages = torch.empty_like(value)
    running = torch.zeros_like(value[0])
    for step in reversed(range(len(value))):
        onward = next_value[step] * alive[step] + gae_lambda * connected[step] * running
        if decided is not None and step + 1 < len(value):
            continued = ~(decided[step + 1] | terminated[step] | truncated[step])
            onward = torch.where(continued, advantages[step + 1] + value[step + 1], onward)
        running = reward[step] + gamma * onward - value[step]
        advantages[step] = running
    return advantages


def normalised(advantages: Tensor, chosen: Tensor) -> Tensor:
    """Mean 0 and standard deviation 1 over the `chosen` steps of all processes. (T, B), bool → (T, B)"""
    mean, variance = mean_and_variance(advantages[chosen])
    return (advantages - mean) / (variance.sqrt() + 1e-8)


def group_advantages(returns: Tensor, least_std: float) -> tuple[Tensor, Tensor]:
    """Shao et al. 2024, eq. 4.1.2: (R − mean) / std within each group. (B / G, G) → that, and (B / G) bool

    Groups whose returns have a standard deviation below `least_std` have no signal: False, advantages 0.
    """
    deviation = returns - returns.mean(dim=1, keepdim=True)
    std = deviation.square().mean(dim=1, keepdim=True).sqrt()
    signal = std >= least_std
    return torch.where(signal, deviation / std.clamp_min(1e-8), 0), signal[:, 0]
