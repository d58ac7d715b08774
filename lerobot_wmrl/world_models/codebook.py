"""What a token is made of: one digit a code factor, and the logits over them.

Codes are handled factor by factor: a token of FSQ levels (8, 5, 5, 5) costs 23 logits instead of 1000, and
near misses of a level are near misses of the embedding.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class CodeBook(nn.Module):
    """Arithmetic between tokens, their digits (one level index a factor) and grids of code values."""

    factor_of_logit: Tensor
    level_of_logit: Tensor
    levels: Tensor
    basis: Tensor

    def __init__(self, levels: Sequence[int]) -> None:
        super().__init__()
        self.level_counts = tuple(levels)
        factors = [factor for factor, count in enumerate(levels) for _ in range(count)]
        within = [level for count in levels for level in range(count)]
        basis = torch.tensor([1, *levels[:-1]]).cumprod(0)
        for name, values in (
            ("factor_of_logit", factors),
            ("level_of_logit", within),
            ("levels", list(levels)),
        ):
            self.register_buffer(name, torch.tensor(values), persistent=False)
        self.register_buffer("basis", basis, persistent=False)

    def digits(self, tokens: Tensor) -> Tensor:
        """Tokens (…) → level indices (…, C)."""
        return tokens[..., None] // self.basis % self.levels

    def tokens(self, digits: Tensor) -> Tensor:
        """Level indices (…, C) → tokens (…)."""
        return (digits * self.basis).sum(-1)

    def values(self, digits: Tensor) -> Tensor:
        """Level indices (…, C) → values in [−1, 1] (…, C)."""
        return digits * 2.0 / (self.levels - 1) - 1.0

    def one_hot(self, digits: Tensor) -> Tensor:
        """Level indices (…, C) → (…, V), one 1 a factor."""
        return (digits[..., self.factor_of_logit] == self.level_of_logit).float()

    def cross_entropy(self, logits: Tensor, digits: Tensor) -> Tensor:
        """Eq. 2 summed over factors: logits (…, V), digits (…, C) → nats a token (…)."""
        losses = [
            F.cross_entropy(part.movedim(-1, 1), digits[..., factor], reduction="none")
            for factor, part in enumerate(logits.split(self.level_counts, -1))
        ]
        return torch.stack(losses).sum(0)

    def entropy(self, logits: Tensor) -> Tensor:
        """Mean entropy of a code factor's prediction in nats: logits (B, S, V) → (B,)."""
        parts = [torch.special.entr(part.softmax(-1)).sum(-1) for part in logits.split(self.level_counts, -1)]
        return torch.stack(parts).mean((0, 2))

    def sample(self, logits: Tensor, temperature: float, generator: torch.Generator | None) -> Tensor:
        """Gumbel-argmax at a temperature on the logits (0: the most likely level). (…, V) → digits (…, C)."""
        if temperature > 0:
            uniform = torch.rand(logits.shape, device=logits.device, generator=generator).clamp_min(1e-9)
            logits = logits / temperature - (-uniform.log()).log()
        return torch.stack([part.argmax(-1) for part in logits.split(self.level_counts, -1)], -1)
