"""LeRobot's ACT as a StochasticPolicy, without a change to its code.

B environments, n steps of a decision, K action components, D width of ACT's decoder.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor, nn
from torch.distributions import Normal

from lerobot_wmrl.rl.protocol import Observation

INITIAL_STD = 0.1
"""In normalised actions: cloning by ACT's L1 loss says nothing of a spread."""

VALUE_WIDTH = 256


class Sample(NamedTuple):
    """Actions and log-probs (B, n, K), values (B,)."""

    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class ActAdapter(nn.Module):
    """π(a|o) = N(chunk(o), std): a decision is the `n_action_steps` first actions of ACT's chunk, acted
    without a look in between, as ACT does. Adds one std a component, and a value.

    The value is an MLP on what ACT's decoder makes of the first action; nothing of it flows back into ACT.
    """

    def __init__(self, policy: Any) -> None:
        super().__init__()
        config = policy.config
        if config.temporal_ensemble_coeff is not None:
            raise ValueError(
                "policy.temporal_ensemble_coeff: averaged chunks have no log-probability, give "
                "--policy.temporal_ensemble_coeff=null"
            )
        self.policy, self.config = policy, config
        width, actions = config.dim_model, config.action_feature.shape[0]
        device = next(policy.parameters()).device
        self.log_std = nn.Parameter(torch.full((actions,), math.log(INITIAL_STD), device=device))
        self.critic = nn.Sequential(
            nn.Linear(width, VALUE_WIDTH), nn.SiLU(), nn.Linear(VALUE_WIDTH, 1), nn.Flatten(0)
        ).to(device)

    def sample(self, observation: Observation) -> Sample:
        """Draw a decision; `evaluate` gives these log-probs again."""
        distribution, value = self._decide(observation)
        raw_action = distribution.sample()
        return Sample(raw_action, distribution.log_prob(raw_action), value)

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """→ log-probs (B, n, K), entropies (B,), values (B,)"""
        distribution, value = self._decide(observation)
        return distribution.log_prob(raw_action), distribution.entropy().sum(dim=(1, 2)), value

    def value(self, observation: Observation) -> Tensor:
        """V(o). → (B,)"""
        return self._decide(observation)[1]

    def value_parameters(self) -> Iterator[nn.Parameter]:
        return self.critic.parameters()

    @torch.no_grad()
    def set_std(self, std: float) -> None:
        """Start exploration from `std` in every component."""
        if std <= 0:
            raise ValueError(f"initial_std={std}: must be above 0")
        self.log_std.fill_(math.log(std))

    def own_tensors(self) -> dict[str, Tensor]:
        """What is added to ACT, by name."""
        return {name: value for name, value in self.state_dict().items() if not name.startswith("policy.")}

    def _decide(self, observation: Observation) -> tuple[Normal, Tensor]:
        """Distribution of the next n actions, and the value. → (B, n, K), (B,)"""
        images = {OBS_IMAGES: [observation[camera] for camera in self.config.image_features]}
        decoded: list[Tensor] = []
        hook = self.policy.model.action_head.register_forward_pre_hook(
            lambda _, inputs: decoded.append(inputs[0])
        )
        try:
            chunk = self.policy.model({**observation, **(images if images[OBS_IMAGES] else {})})[0]
        finally:
            hook.remove()
        mean = chunk[:, : self.config.n_action_steps]
        return Normal(mean, self.log_std.exp(), validate_args=False), self.critic(decoded[0][:, 0].detach())
