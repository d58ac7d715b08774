"""The condition of eq. 1, an action or an instruction, as tokens."""

from typing import NamedTuple

from torch import Tensor


class Condition(NamedTuple):
    """The condition c of eq. 1.

    tokens (B, T or 1, M, D); mask (B, 1, 1, 1, M), True for the tokens that count, None if all do;
    instruction_weights (B, 1, E), by which the instruction lets success be read, None unless the model reads
    it.
    """

    tokens: Tensor
    mask: Tensor | None = None
    instruction_weights: Tensor | None = None

    def mean(self) -> Tensor:
        """Mean of the tokens that count. → (B, T or 1, D)"""
        if self.mask is None:
            return self.tokens.mean(2)
        kept = self.mask[:, :, 0, 0, :, None].to(self.tokens.dtype)
        return (self.tokens * kept).sum(2) / kept.sum(2).clamp_min(1)
