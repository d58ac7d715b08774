"""Interface between a policy and reinforcement learning. B environments, K action components.

A policy may decide on n steps at once (an action chunk). Its raw actions and log-probabilities are then
(B, n, K) instead of (B, K). The n actions are executed one after the other. The policy decides again after n
steps or when a new episode begins.
"""

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from torch import Tensor, nn

from lerobot_wmrl.common.constants import Observation


class ActionSample(Protocol):
    """Actions as the policy draws them, before any clipping or unnormalisation."""

    @property
    def raw_action(self) -> Tensor:
        """Actions, of any dtype. (B, K)"""

    @property
    def log_prob(self) -> Tensor:
        """Log-probability of each component, float32. (B, K)"""

    @property
    def value(self) -> Tensor:
        """Value V(o). (B,)"""


@runtime_checkable
class StochasticPolicy(Protocol):
    """A policy that draws actions and knows their probability. Observations come from its preprocessor."""

    def sample(self, observation: Observation) -> ActionSample:
        """Draw actions from the distribution that `evaluate` measures."""

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-probabilities (B, K), entropies (B,) of the whole decision and values (B,)."""

    def value(self, observation: Observation) -> Tensor:
        """Return the values V(o). (B,)"""

    def value_parameters(self) -> Iterable[nn.Parameter]:
        """Return the parameters that only the value depends on."""


@runtime_checkable
class EncodingPolicy(Protocol):
    """A stochastic policy that can keep its encoder as it is, so that a rollout encodes every frame once."""

    def freeze_encoder(self) -> None:
        """Leave the encoder out of all later training."""

    def encode(self, observation: Observation) -> Observation:
        """Return what the encoder makes of an observation; the policy's methods take it in its place."""
