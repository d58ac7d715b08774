"""How far one optimizer step may move a policy."""

import math
from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

UNDONE_KL: Final = 10.0
"""A step that moves the policy by more than this many times the target is undone."""

LEAST_LR_FACTOR: Final = 0.1
"""The least factor by which the learning rate falls then. Estimates of a large KL are far too large."""

LR_RECOVERY: Final = 1.1
"""Factor by which it rises again, up to its full value, in each iteration that stays within the target."""


class TrustRegion:
    """Undoes a step that has moved the policy much too far, and shortens the steps after it for a while.

    Args:
        parameters: the policy's.
        optimizer: steps them.
        group: index of their parameter group in it.
        target_kl: KL divergence, in nats a step of the environment, that an iteration should stay within.
    """

    def __init__(
        self, parameters: Sequence[nn.Parameter], optimizer: Optimizer, group: int, target_kl: float
    ) -> None:
        self.parameters, self.optimizer, self.index, self.target_kl = parameters, optimizer, group, target_kl
        self.full_lr: float = self.group["lr"]
        self.before: list[Tensor] = []

    @property
    def group(self) -> dict[str, Any]:
        """The policy's parameter group, with its learning rate. An optimizer that loads has new ones."""
        found: dict[str, Any] = self.optimizer.param_groups[self.index]
        return found

    @property
    def has_stepped(self) -> bool:
        """Whether there is a step that can be undone."""
        return bool(self.before)

    def remember(self) -> None:
        """Keep the parameters as they are before a step."""
        self.before = [parameter.detach().clone() for parameter in self.parameters]

    def forget(self) -> None:
        """Let go of the parameters that were kept."""
        self.before = []

    @torch.no_grad()
    def undo_if_exceeded(self, kl: float) -> bool:
        """Undo the last step if it has moved the policy by far more than the target; return whether it did.

        The learning rate falls then, so that the next step comes to the target: the KL grows with the square
        of a step. A KL that has overflowed is too far as well.
        """
        if not self.has_stepped or kl <= UNDONE_KL * self.target_kl:
            return False
        for parameter, old in zip(self.parameters, self.before, strict=True):
            parameter.copy_(old)
        factor = max(LEAST_LR_FACTOR, math.sqrt(self.target_kl / kl))  # the former for NaN too
        self.group["lr"] *= factor
        return True

    def recover(self) -> None:
        """Let steps be a little longer again, after an iteration that has stayed within the target."""
        self.group["lr"] = min(self.full_lr, LR_RECOVERY * self.group["lr"])
