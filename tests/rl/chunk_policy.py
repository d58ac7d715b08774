"""A small policy for PointEnv that decides on several steps at once."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal

ACTIONS = 3


class Sample(NamedTuple):
    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class ChunkPolicy(nn.Module):
    """Gaussian of `chunk` actions around a network's; remembers for how many rows it was asked."""

    def __init__(self, chunk: int, std: float = 0.5) -> None:
        super().__init__()
        self.config, self.chunk, self.asked = SimpleNamespace(type="chunk"), chunk, list[int]()
        self.actor = nn.Sequential(nn.Linear(4, 32), nn.Tanh(), nn.Linear(32, chunk * ACTIONS))
        self.critic = nn.Sequential(nn.Linear(4, 32), nn.Tanh(), nn.Linear(32, 1))
        self.log_std = nn.Parameter(torch.full((ACTIONS,), std).log())

    def _distribution(self, observation: dict[str, Any]) -> Normal:
        mean = self.actor(observation["observation.state"]).view(-1, self.chunk, ACTIONS)
        return Normal(mean, self.log_std.exp(), validate_args=False)

    def sample(self, observation: dict[str, Any]) -> Sample:
        distribution = self._distribution(observation)
        raw_action = distribution.sample()
        self.asked.append(len(raw_action))
        return Sample(raw_action, distribution.log_prob(raw_action), self.value(observation))

    def evaluate(self, observation: dict[str, Any], raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        distribution = self._distribution(observation)
        entropy = distribution.entropy().sum(dim=(1, 2))
        return distribution.log_prob(raw_action), entropy, self.value(observation)

    def value(self, observation: dict[str, Any]) -> Tensor:
        return self.critic(observation["observation.state"]).squeeze(1)

    def value_parameters(self) -> Any:
        return self.critic.parameters()
