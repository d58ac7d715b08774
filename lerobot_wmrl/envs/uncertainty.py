"""When the world model does not know: a guard against policies that learn to do well where it is wrong."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.distributions import Bernoulli

from lerobot_wmrl.world_models.imagination import Imagined


def entropies(imagined: Imagined) -> dict[str, Tensor]:
    """How unsure the model is of what a frame looks like, and of its being a success: nats. (B,) each"""
    done = Bernoulli(logits=imagined.done_logit, validate_args=False)
    return {"token_entropy": imagined.entropy, "done_entropy": done.entropy()}


SIGNALS: Final = ("token_entropy", "done_entropy")
EFFECTS: Final = ("end", "weight")


@dataclass
class Uncertainty:
    """What becomes of an imagined episode that the world model is not sure of; nothing without a limit.

    Args:
        limit: nats above which a frame is uncertain.
        signal: `token_entropy`, of what it looks like, the mean over its codes, or `done_entropy`, of its
            being a success (at most 0.69).
        effect: `end` truncates the episode there, without success; `weight` multiplies the reward of the
            frame by limit / uncertainty.
    """

    limit: float | None = None
    signal: str = "token_entropy"
    effect: str = "end"

    def check(self) -> None:
        """ValueError names the field that cannot be."""
        for name, known in (("signal", SIGNALS), ("effect", EFFECTS)):
            if getattr(self, name) not in known:
                raise ValueError(f"--env.uncertainty.{name}={getattr(self, name)}: choose {', '.join(known)}")
        if self.limit is not None and not self.limit > 0:
            raise ValueError(
                f"--env.uncertainty.limit={self.limit}: must be above 0; leave it out for no guard"
            )

    def ends(self, entropy: Mapping[str, Tensor]) -> Tensor:
        """Which episodes are cut here, by `entropies`. → (B,)"""
        uncertainty = entropy[self.signal]
        if self.limit is None or self.effect != "end":
            return torch.zeros_like(uncertainty, dtype=torch.bool)
        return uncertainty > self.limit

    def weigh(self, reward: Tensor, entropy: Mapping[str, Tensor]) -> Tensor:
        """The reward as it is paid. (B,) → (B,)"""
        if self.limit is None or self.effect != "weight":
            return reward
        return reward * (self.limit / entropy[self.signal].clamp_min(self.limit))
