"""Adapters that make LeRobot's policies stochastic without a change to their code.

B environments, n steps of a decision, K action components, D width of ACT's decoder.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor, nn
from torch.distributions import Normal

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import unwrapped
from lerobot_wmrl.common.policy_checks import require_chunks
from lerobot_wmrl.rl.protocol import StochasticPolicy

INITIAL_STD = 0.1
"""Standard deviation that exploration starts from, in normalised actions: ACT's L1 loss learns none."""

VALUE_WIDTH = 256


class ChunkSample(NamedTuple):
    """Actions of n steps, their log-probabilities and the value."""

    raw_action: Tensor  # (B, n, K)
    log_prob: Tensor  # (B, n, K)
    value: Tensor  # (B,)


class ActAdapter(nn.Module):
    """ACT as a StochasticPolicy: π(a|o) = N(chunk(o), std), with a learnable std for each action component.

    A decision is the first `n_action_steps` actions of ACT's chunk, executed without a new observation, as
    ACT does. The value is an MLP on the decoder's feature of the first action; its gradient stops there.
    """

    def __init__(self, policy: Any) -> None:
        super().__init__()
        config = policy.config
        require_chunks(config)
        self.policy, self.config = policy, config
        width, actions = config.dim_model, config.action_feature.shape[0]
        device = next(policy.parameters()).device
        self.log_std = nn.Parameter(torch.full((actions,), math.log(INITIAL_STD), device=device))  # (K,)
        self.critic = nn.Sequential(
            nn.Linear(width, VALUE_WIDTH), nn.SiLU(), nn.Linear(VALUE_WIDTH, 1), nn.Flatten(0)
        ).to(device)  # (B, D) → (B,)

    def sample(self, observation: Observation) -> ChunkSample:
        """Draw the next n actions. (B, n, K)"""
        distribution, value = self._decide(observation)
        raw_action = distribution.sample()
        return ChunkSample(raw_action, distribution.log_prob(raw_action), value)

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-probabilities (B, n, K), entropies (B,) and values (B,)."""
        distribution, value = self._decide(observation)
        return distribution.log_prob(raw_action), distribution.entropy().sum(dim=(1, 2)), value

    def value(self, observation: Observation) -> Tensor:
        """Return the values V(o). (B,)"""
        return self._decide(observation)[1]

    def value_parameters(self) -> Iterator[nn.Parameter]:
        """Return the parameters of the MLP."""
        return self.critic.parameters()

    @torch.no_grad()
    def set_std(self, std: float) -> None:
        """Start exploration from `std` in every component."""
        self.log_std.fill_(math.log(std))

    def own_tensors(self) -> dict[str, Tensor]:
        """Return the tensors that are not in ACT's own checkpoint, by name."""
        return {name: value for name, value in self.state_dict().items() if not name.startswith("policy.")}

    def _decide(self, observation: Observation) -> tuple[Normal, Tensor]:
        """Return the distribution of the next n actions (B, n, K) and the values (B,)."""
        images = {OBS_IMAGES: [observation[camera] for camera in self.config.image_features]}
        decoded: list[Tensor] = []  # (B, chunk, D)
        network = unwrapped(self.policy).model
        hook = network.action_head.register_forward_pre_hook(lambda _, inputs: decoded.append(inputs[0]))
        try:
            chunk = network({**observation, **(images if images[OBS_IMAGES] else {})})[0]
        finally:
            hook.remove()
        mean = chunk[:, : self.config.n_action_steps]  # (B, n, K)
        return Normal(mean, self.log_std.exp(), validate_args=False), self.critic(decoded[0][:, 0].detach())


ADAPTERS = {"act": ActAdapter}
"""Adapters by policy type. Their `own_tensors` are saved with the algorithm, not with the policy."""


def as_stochastic(policy: Any) -> Any:
    """Return the policy itself if it is stochastic, else the policy in its adapter.

    Raises:
        FieldError: there is no adapter for this type of policy.
    """
    if isinstance(unwrapped(policy), StochasticPolicy):
        return policy
    if policy.config.type not in ADAPTERS:
        raise FieldError(
            "policy.type",
            policy.config.type,
            "reinforcement learning needs a policy with `sample`, `evaluate`, `value` and `value_parameters`",
            f"take one that has them, for example cnn, or one of {', '.join(ADAPTERS)}",
        )
    return ADAPTERS[policy.config.type](policy)
