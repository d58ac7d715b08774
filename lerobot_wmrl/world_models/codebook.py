"""Arithmetic of tokens: the codes a token consists of, the values they stand for, and the logits over them.

A token has one code for each of its C factors. Networks predict it factor by factor: a token of FSQ levels
(8, 5, 5, 5) costs 23 logits instead of 1000, one of 18 LFQ bits as two factors of 512 costs 1024 instead of
262,144. Networks read the values and not the index: near misses of a code are near misses of its embedding.
"""

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class CodeBook(nn.Module):
    """Codes of finite scalar quantisation: a code is the index of a level, its value lies in [−1, 1].

    Letters in shapes: C factors of a token, K values it stands for, V logits over all codes of all factors.

    Args:
        levels: codes of each factor. A token is the number whose digits in this mixed radix are its codes.
    """

    factor_of_logit: Tensor
    level_of_logit: Tensor
    levels: Tensor
    basis: Tensor

    def __init__(self, levels: Sequence[int]) -> None:
        super().__init__()
        self.level_counts = tuple(levels)
        constants = {
            "factor_of_logit": [factor for factor, count in enumerate(levels) for _ in range(count)],
            "level_of_logit": [level for count in levels for level in range(count)],
            "levels": list(levels),
        }
        for name, values in constants.items():
            self.register_buffer(name, torch.tensor(values), persistent=False)
        self.register_buffer("basis", torch.tensor([1, *levels[:-1]]).cumprod(0), persistent=False)

    @property
    def channels(self) -> int:
        """K, values that a token stands for."""
        return len(self.level_counts)

    def codes(self, tokens: Tensor) -> Tensor:
        """Tokens (…) → codes (…, C)."""
        return tokens[..., None] // self.basis % self.levels

    def tokens(self, codes: Tensor) -> Tensor:
        """Codes (…, C) → tokens (…)."""
        return (codes * self.basis).sum(-1)

    def values(self, codes: Tensor) -> Tensor:
        """Codes (…, C) → values in [−1, 1] (…, K)."""
        return codes * 2.0 / (self.levels - 1) - 1.0

    def expected_values(self, logits: Tensor) -> Tensor:
        """Average the values under the predicted probabilities: logits (…, V) → (…, K)."""
        means = []
        for factor, part in enumerate(logits.split(self.level_counts, -1)):
            codes = part.new_zeros(part.shape[-1], len(self.level_counts), dtype=torch.long)
            codes[:, factor] = torch.arange(len(codes), device=codes.device)
            values = self.values(codes).unflatten(-1, (len(self.level_counts), -1))[:, factor]
            means.append(part.softmax(-1) @ values)
        return torch.cat(means, -1)

    def distance(self, codes: Tensor, other: Tensor) -> Tensor:
        """Count the levels between two tokens, summed over factors: codes (…, C) twice → (…)."""
        return (codes - other).abs().sum(-1)

    def neighbors(self, codes: Tensor) -> Tensor:
        """Move every code (…, C) one level up or down at random, if there is one."""
        shift = torch.randint(0, 2, codes.shape, device=codes.device) * 2 - 1
        return (codes + shift).clamp_min(0).minimum(self.levels - 1)

    def one_hot(self, codes: Tensor) -> Tensor:
        """Codes (…, C) → (…, V), one 1 a factor."""
        return (codes[..., self.factor_of_logit] == self.level_of_logit).float()

    def cross_entropy(self, logits: Tensor, codes: Tensor) -> Tensor:
        """Eq. 2 summed over factors: logits (…, V), codes (…, C) → nats a token (…)."""
        losses = [
            F.cross_entropy(part.movedim(-1, 1), codes[..., factor], reduction="none")
            for factor, part in enumerate(logits.split(self.level_counts, -1))
        ]
        return torch.stack(losses).sum(0)

    def entropy(self, logits: Tensor) -> Tensor:
        """Mean entropy of a factor's prediction in nats: logits (B, S, V) → (B,)."""
        logs = [part.log_softmax(-1) for part in logits.split(self.level_counts, -1)]
        return torch.stack([-(each.exp() * each).sum(-1) for each in logs]).mean((0, 2))

    def most_likely(self, logits: Tensor) -> Tensor:
        """Return the most likely code of each factor: logits (…, V) → codes (…, C)."""
        return torch.stack([part.argmax(-1) for part in logits.split(self.level_counts, -1)], -1)


class BinaryCodeBook(CodeBook):
    """Codes of lookup-free quantisation (Yu et al. 2024, eq. 3): a factor of 2^b codes is b signs.

    A code has the signs as its bits, the first sign as the highest.
    """

    place: Tensor

    def __init__(self, levels: Sequence[int]) -> None:
        super().__init__(levels)
        self.bits = levels[0].bit_length() - 1
        self.register_buffer("place", torch.arange(self.bits - 1, -1, -1), persistent=False)

    @property
    def channels(self) -> int:
        return len(self.level_counts) * self.bits

    def values(self, codes: Tensor) -> Tensor:
        """Codes (…, C) → signs, −1 or 1, (…, K)."""
        return ((codes[..., None] >> self.place) & 1).flatten(-2) * 2.0 - 1.0

    def distance(self, codes: Tensor, other: Tensor) -> Tensor:
        """Count the signs in which two tokens differ: codes (…, C) twice → (…)."""
        return (self.values(codes) != self.values(other)).sum(-1)

    def neighbors(self, codes: Tensor) -> Tensor:
        """Flip one sign of every code (…, C) at random."""
        return codes ^ (1 << torch.randint(0, self.bits, codes.shape, device=codes.device))


CODEBOOKS: Final[dict[str, type[CodeBook]]] = {"fsq": CodeBook, "lfq": BinaryCodeBook}


def make_codebook(quantizer: str, levels: Sequence[int]) -> CodeBook:
    """Return the code book of `fsq` or `lfq`."""
    return CODEBOOKS[quantizer](levels)


def perplexity(tokens: Tensor) -> float:
    """Return the exponential of the entropy of tokens (…): how many are in use, were all equally frequent."""
    counts = tokens.unique(return_counts=True)[1].cpu().double()
    return torch.special.entr(counts / counts.sum()).sum().exp().item()
