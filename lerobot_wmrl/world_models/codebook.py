"""What a token is made of: one digit a code factor, the logits over them, and what the digits stand for.

Codes are handled factor by factor: a token of FSQ levels (8, 5, 5, 5) costs 23 logits instead of 1000, one of
18 LFQ bits as two factors of 512 costs 1024 instead of 262,144. Near misses of a code are near misses of the
embedding, since networks see the code's values and not its index.
"""

from collections.abc import Sequence
from functools import partial
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.common.distributed import draw_own_rows


def gumbel(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Standard Gumbel noise of that shape."""
    uniform = torch.rand(like.shape, device=like.device, generator=generator).clamp_min(1e-9)
    return -(-uniform.log()).log()


class CodeBook(nn.Module):
    """Finite scalar quantisation: a factor is one value in [−1, 1], its digit the index of its level.

    Arithmetic between tokens, their digits (one a factor) and the values that they stand for.

    Args:
        levels: codes of each factor. A token is the number whose digits in this mixed radix they are.
    """

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

    @property
    def channels(self) -> int:
        """K, values that a token stands for."""
        return len(self.level_counts)

    def digits(self, tokens: Tensor) -> Tensor:
        """Tokens (…) → digits (…, C)."""
        return tokens[..., None] // self.basis % self.levels

    def tokens(self, digits: Tensor) -> Tensor:
        """Digits (…, C) → tokens (…)."""
        return (digits * self.basis).sum(-1)

    def values(self, digits: Tensor) -> Tensor:
        """Digits (…, C) → values in [−1, 1] (…, K)."""
        return digits * 2.0 / (self.levels - 1) - 1.0

    def expected_values(self, logits: Tensor) -> Tensor:
        """Means of the values under the predicted probabilities: logits (…, V) → (…, K)."""
        means = []
        for factor, part in enumerate(logits.split(self.level_counts, -1)):
            codes = part.new_zeros(part.shape[-1], len(self.level_counts), dtype=torch.long)
            codes[:, factor] = torch.arange(len(codes), device=codes.device)
            values = self.values(codes).unflatten(-1, (len(self.level_counts), -1))[:, factor]
            means.append(part.softmax(-1) @ values)
        return torch.cat(means, -1)

    def distance(self, digits: Tensor, other: Tensor) -> Tensor:
        """Steps between two codes, levels summed over factors: digits (…, C) twice → (…)."""
        return (digits - other).abs().sum(-1)

    def neighbors(self, digits: Tensor) -> Tensor:
        """Each digit (…, C) one step further, at random: one level up or down, if there is one."""
        shift = draw_own_rows(partial(torch.randint, 0, 2), digits.shape, digits.device) * 2 - 1
        return (digits + shift).clamp_min(0).minimum(self.levels - 1)

    def one_hot(self, digits: Tensor) -> Tensor:
        """Digits (…, C) → (…, V), one 1 a factor."""
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
        """Gumbel-argmax at a temperature on the logits (0: the most likely code). (…, V) → digits (…, C)."""
        if temperature > 0:
            logits = logits / temperature + gumbel(logits, generator)
        return torch.stack([part.argmax(-1) for part in logits.split(self.level_counts, -1)], -1)


class BinaryCodeBook(CodeBook):
    """Lookup-free quantisation (Yu et al. 2024, eq. 3): a factor of 2^b codes is b signs.

    Its digit has them as bits, the first sign as the highest.
    """

    place: Tensor

    def __init__(self, levels: Sequence[int]) -> None:
        super().__init__(levels)
        self.bits = levels[0].bit_length() - 1
        self.register_buffer("place", torch.arange(self.bits - 1, -1, -1), persistent=False)

    @property
    def channels(self) -> int:
        return len(self.level_counts) * self.bits

    def values(self, digits: Tensor) -> Tensor:
        """Digits (…, C) → signs, −1 or 1, (…, K)."""
        return ((digits[..., None] >> self.place) & 1).flatten(-2) * 2.0 - 1.0

    def distance(self, digits: Tensor, other: Tensor) -> Tensor:
        """Hamming distance: signs that differ. Digits (…, C) twice → (…)."""
        return (self.values(digits) != self.values(other)).sum(-1)

    def neighbors(self, digits: Tensor) -> Tensor:
        """Each digit (…, C) with one of its signs, at random, flipped."""
        return digits ^ (
            1 << draw_own_rows(partial(torch.randint, 0, self.bits), digits.shape, digits.device)
        )


CODEBOOKS: Final[dict[str, type[CodeBook]]] = {"fsq": CodeBook, "lfq": BinaryCodeBook}


def make_codebook(quantizer: str, levels: Sequence[int]) -> CodeBook:
    """Return the code book of `fsq` or `lfq`."""
    return CODEBOOKS[quantizer](levels)
