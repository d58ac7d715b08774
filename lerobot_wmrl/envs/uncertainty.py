"""Uncertainty of the world model: a guard against policies that exploit what it imagines wrongly."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torch.distributions import Bernoulli

from lerobot_wmrl.common.errors import FieldError

if TYPE_CHECKING:
    from lerobot_wmrl.world_models.dynamics import Imagined

SIGNALS: Final = ("token_entropy", "done_entropy")
EFFECTS: Final = ("end", "weight")


def entropies(imagined: "Imagined") -> dict[str, Tensor]:
    """Return how uncertain the model is of each frame's appearance and of its success, in nats. (B,) each"""
    done = Bernoulli(logits=imagined.done_logit, validate_args=False)
    return {"token_entropy": imagined.entropy, "done_entropy": done.entropy()}


@dataclass
class Uncertainty:
    """What becomes of imagined episodes of which the world model is uncertain; nothing without a limit.

    Args:
        limit: nats above which a frame is uncertain.
        signal: `token_entropy`, the entropy of a frame's codes (their mean), or `done_entropy`, that of its
            success (at most 0.69).
        effect: `end` truncates the episode there, without success; `weight` multiplies the frame's reward by
            limit / uncertainty.
    """

    limit: float | None = None
    signal: str = "token_entropy"
    effect: str = "end"

    def check(self) -> None:
        """Raise FieldError for a setting that cannot be, named as a field of the environment."""
        for field, choices in (("signal", SIGNALS), ("effect", EFFECTS)):
            if getattr(self, field) not in choices:
                raise FieldError(
                    f"uncertainty.{field}", getattr(self, field), f"choose one of {', '.join(choices)}"
                )
        if self.limit is not None and not self.limit > 0:
            raise FieldError("uncertainty.limit", self.limit, "must be above 0", "leave it out for no guard")

    def ends(self, entropy: Mapping[str, Tensor]) -> Tensor:
        """Return which episodes end here, given `entropies`. → (B,) bool"""
        uncertainty = entropy[self.signal]
        if self.limit is None or self.effect != "end":
            return torch.zeros_like(uncertainty, dtype=torch.bool)
        return uncertainty > self.limit

    def weigh(self, reward: Tensor, entropy: Mapping[str, Tensor]) -> Tensor:
        """Return the reward, less where the frame is uncertain. A loss stays as it is. (B,) → (B,)"""
        if self.limit is None or self.effect != "weight":
            return reward
        share = self.limit / entropy[self.signal].clamp_min(self.limit)
        return torch.where(reward > 0, reward * share, reward)
