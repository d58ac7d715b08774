"""Attention in plain matmuls, and rotary positions along time."""

from typing import NamedTuple

import torch
from torch import Tensor, nn


def attention(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(Q·Kᵀ/√d)·V with plain matmuls, which beat fused kernels at these sizes on the CPU.

    query (…, h, Q, d), key and value (…, h, K, d), mask broadcastable to (…, h, Q, K), True = attend.
    """
    scores = query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
    if mask is not None:
        scores = scores.masked_fill(~mask, float("-inf"))
    return scores.softmax(-1) @ value


def attention_with_own(
    query: Tensor, key: Tensor, value: Tensor, others: tuple[Tensor, Tensor], mask: Tensor
) -> Tensor:
    """Attention of each query to `others` and to its own key, but to no other query's.

    query, key, value (…, h, Q, d), others: keys and values (…, h, K, d), mask as in `attention`.
    """
    keys, values = others
    scores = (query @ keys.transpose(-1, -2)).masked_fill(~mask, float("-inf"))
    own = (query * key).sum(-1, keepdim=True)
    weights = (torch.cat([scores, own], -1) * query.shape[-1] ** -0.5).softmax(-1)
    return weights[..., :-1] @ values + weights[..., -1:] * value


class Rotation(NamedTuple):
    """Rotary embedding (Su et al. 2021) of T positions: cos and sin (T, d/2) of the angles."""

    cos: Tensor
    sin: Tensor

    @classmethod
    def at(cls, positions: Tensor, head_width: int) -> "Rotation":
        """positions (T,), on their device."""
        half = head_width // 2
        frequencies = 1000.0 ** (-torch.arange(half, device=positions.device) / half)
        angles = positions[:, None].float() * frequencies
        return cls(angles.cos(), angles.sin())

    def __call__(self, x: Tensor) -> Tensor:
        """(…, T, d) → (…, T, d)"""
        cos, sin = self.cos.to(x.dtype), self.sin.to(x.dtype)
        a, b = x.chunk(2, -1)
        return torch.cat([a * cos - b * sin, a * sin + b * cos], -1)


class SelfAttention(nn.Module):
    """Multi-head self-attention with pre-norm, over space or over time."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def split_heads(self, normed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(…, N, D) → query, key, value, each (…, h, N, d)."""
        qkv = self.qkv(normed).unflatten(-1, (3, self.heads, -1))
        query, key, value = qkv.movedim(-3, 0).transpose(-2, -3)
        return query, key, value

    def merge_heads(self, x: Tensor) -> Tensor:
        """(…, h, N, d) → (…, N, D)."""
        return self.out(x.transpose(-2, -3).flatten(-2))
