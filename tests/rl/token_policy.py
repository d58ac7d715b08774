"""A policy whose raw actions are token ids of a large vocabulary, one log-prob a token."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Categorical

FIRST_ID, BINS, TOKENS = 2**53, 16, 3
"""Ids that neither float32 nor float64 tells apart, and choices a token."""


class Sample(NamedTuple):
    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class TokenPolicy(nn.Module):
    """Three tokens a decision. `temperature`, and `log_prob_dtype`, say what goes wrong elsewhere."""

    def __init__(self, temperature: float = 1.0, log_prob_dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.config, self.temperature = SimpleNamespace(type="tokens"), temperature
        self.log_prob_dtype = log_prob_dtype
        self.actor = nn.Sequential(nn.Linear(4, 32), nn.Tanh(), nn.Linear(32, TOKENS * BINS))
        self.critic = nn.Linear(4, 1)

    def _tokens(self, observation: dict[str, Any]) -> Categorical:
        logits = 3 * self.actor(observation["observation.state"])
        return Categorical(logits=logits.view(-1, TOKENS, BINS))

    def sample(self, observation: dict[str, Any]) -> Sample:
        distribution = self._tokens(observation)
        drawn = Categorical(logits=distribution.logits / self.temperature).sample()
        log_prob = distribution.log_prob(drawn).to(self.log_prob_dtype)
        return Sample(FIRST_ID + drawn, log_prob, self.value(observation))

    def evaluate(self, observation: dict[str, Any], raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        distribution = self._tokens(observation)
        log_prob = distribution.log_prob(raw_action - FIRST_ID)
        return log_prob, distribution.entropy().sum(dim=1), self.value(observation)

    def value(self, observation: dict[str, Any]) -> Tensor:
        return self.critic(observation["observation.state"]).squeeze(1)

    def value_parameters(self) -> Any:
        return self.critic.parameters()


def to_metres(raw_action: Tensor) -> Tensor:
    """The middles of the bins of [−0.1, 0.1]."""
    return ((raw_action - FIRST_ID).float() + 0.5) / BINS * 0.2 - 0.1
