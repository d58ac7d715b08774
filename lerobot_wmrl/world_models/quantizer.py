"""Quantizers of the frame tokenizer: vectors to tokens and the values they stand for, without a learnt table.

FSQ (Mentzer et al. 2023, eq. 1) rounds every factor to its levels: no auxiliary losses and no dead codes. LFQ
(MAGVIT-2, Yu et al. 2024, eqs. 3-5) keeps the signs, and pays for undecided vectors and unused codes.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn
from vector_quantize_pytorch import FSQ, LFQ

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.world_models.codebook import BinaryCodeBook

ENTROPY_WEIGHT: Final = 0.1
"""Weight of LFQ's entropy term, as in MAGVIT-2: the entropy of a single token's code, which should be low,
minus that of the codes of all tokens, which should be high."""

COMMITMENT_WEIGHT: Final = 0.25
"""Weight of the squared distance between a vector and its signs."""


class Quantized(NamedTuple):
    """Quantised values and tokens of F grids of vectors.

    Args:
        values: (F, K, g, g), through which gradients pass as if nothing was rounded.
        tokens: (F, g, g) int64.
        loss: (), 0 outside training.
        metrics: metrics to log in training.
    """

    values: Tensor
    tokens: Tensor
    loss: Tensor
    metrics: dict[str, float]


class FiniteScalarQuantizer(nn.Module):
    """Finite scalar quantisation: one channel a factor."""

    def __init__(self, levels: Sequence[int]) -> None:
        super().__init__()
        self.fsq = FSQ(list(levels))

    def forward(self, vectors: Tensor) -> Quantized:
        """Vectors (F, K, g, g) → their values and tokens."""
        values, tokens = self.fsq(vectors)
        return Quantized(values, tokens.long(), values.new_zeros(()), {})

    def values(self, tokens: Tensor) -> Tensor:
        """Tokens (F, g, g) → values (F, K, g, g)."""
        return self.fsq.indices_to_codes(tokens)


class LookupFreeQuantizer(nn.Module):
    """Lookup-free quantisation: a factor of 2^b codes takes b channels.

    Entropies are those of a factor's codes, not of whole tokens.
    """

    def __init__(self, levels: Sequence[int]) -> None:
        super().__init__()
        self.codebook = BinaryCodeBook(levels)
        self.lfq = LFQ(
            codebook_size=levels[0],
            num_codebooks=len(levels),
            keep_num_codebooks_dim=True,
            entropy_loss_weight=ENTROPY_WEIGHT,
            commitment_loss_weight=COMMITMENT_WEIGHT,
        )

    def forward(self, vectors: Tensor) -> Quantized:
        """Vectors (F, K, g, g) → their values and tokens; in training also the loss (eqs. 4, 5) in nats."""
        with compute_in(torch.float32, vectors.device):
            (values, codes, loss), parts = self.lfq(vectors.float(), return_loss_breakdown=True)
        metrics = {
            "quantizer_loss": loss.item(),
            "token_entropy": parts.per_sample_entropy.item(),
            "code_entropy": parts.batch_entropy.item(),
            "commitment_loss": parts.commitment.item(),
        }
        return Quantized(values, self.codebook.tokens(codes.long()), loss, metrics if self.training else {})

    def values(self, tokens: Tensor) -> Tensor:
        """Tokens (F, g, g) → values (F, K, g, g)."""
        return self.lfq.indices_to_codes(self.codebook.codes(tokens))


def make_quantizer(name: str, levels: Sequence[int]) -> FiniteScalarQuantizer | LookupFreeQuantizer:
    """Return the quantizer `fsq` or `lfq`."""
    return FiniteScalarQuantizer(levels) if name == "fsq" else LookupFreeQuantizer(levels)
