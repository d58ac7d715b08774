"""Spatial-temporal transformer: attention inside a frame, causal attention along time, condition, MLP.

Time positions are rotary and therefore relative: the window slides over rollouts of any length. Keys and
values of past frames live in a preallocated ring, so an imagined frame costs one frame's forward pass.
"""

from dataclasses import dataclass
from typing import cast

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


def rotate_by_time(x: Tensor, positions: Tensor) -> Tensor:
    """Rotary embedding (Su et al. 2021): x (…, T, d), positions (T,) → (…, T, d)."""
    half = x.shape[-1] // 2
    frequencies = 1000.0 ** (-torch.arange(half, device=x.device) / half)
    angles = positions[:, None].float() * frequencies
    cos, sin = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
    a, b = x[..., :half], x[..., half:]
    return torch.cat([a * cos - b * sin, a * sin + b * cos], -1)


def banded_causal_mask(length: int, window: int, device: torch.device) -> Tensor:
    """True where frame q may see frame k: q − window < k ≤ q. → (T, T)."""
    index = torch.arange(length, device=device)
    lag = index[:, None] - index[None, :]
    return (lag >= 0) & (lag < window)


@dataclass
class TemporalCache:
    """Keys and values of the last `window` frames of every environment, a ring over time.

    keys, values: (L, B, S, h, window, d). `position` is the number of frames written so far,
    `started` (B,) the position of each environment's first frame: older slots are masked.
    """

    keys: Tensor
    values: Tensor
    started: Tensor
    position: int = 0

    @property
    def window(self) -> int:
        return self.keys.shape[-2]

    def slot_mask(self) -> Tensor:
        """Which slots hold frames of the current episode, the frame at `position` included. → (B, filled)."""
        filled = min(self.position + 1, self.window)
        slots = torch.arange(filled, device=self.started.device)
        held = self.position - (self.position - slots) % self.window
        return held >= self.started[:, None]


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

    def split_heads(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(…, N, D) → query, key, value, each (…, h, N, d)."""
        qkv = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1))
        query, key, value = qkv.movedim(-3, 0).transpose(-2, -3)
        return query, key, value

    def merge_heads(self, x: Tensor) -> Tensor:
        """(…, h, N, d) → (…, N, D)."""
        return self.out(x.transpose(-2, -3).flatten(-2))


class CrossAttention(nn.Module):
    """Tokens ask the condition: x (B, T, S, D), condition (B, T or 1, M, D), mask (B, 1, 1, 1, M) or None."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width, bias=False)
        self.key_value = nn.Linear(width, 2 * width, bias=False)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, condition: Tensor, mask: Tensor | None) -> Tensor:
        query = self.query(self.norm(x)).unflatten(-1, (self.heads, -1)).transpose(-2, -3)
        key_value = self.key_value(condition).unflatten(-1, (2, self.heads, -1))
        key, value = key_value.movedim(-3, 0).transpose(-2, -3)
        return x + self.out(attention(query, key, value, mask).transpose(-2, -3).flatten(-2))


class SpatialTemporalBlock(nn.Module):
    """Space, time, condition, MLP; each with pre-norm and a skip."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.space = SelfAttention(width, heads)
        self.time = SelfAttention(width, heads)
        self.condition = CrossAttention(width, heads)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.GELU("tanh"), nn.Linear(4 * width, width)
        )

    def attend_space(self, x: Tensor) -> Tensor:
        """Every token of a frame sees the whole frame. (B, T, S, D) → same."""
        return x + self.space.merge_heads(attention(*self.space.split_heads(x)))

    def forward(
        self, x: Tensor, condition: Tensor, condition_mask: Tensor | None, time_mask: Tensor
    ) -> Tensor:
        """Training pass over whole clips: x (B, T, S, D), time_mask (T, T)."""
        x = self.attend_space(x)
        query, key, value = self.time.split_heads(x.transpose(1, 2))
        positions = torch.arange(x.shape[1], device=x.device)
        query, key = rotate_by_time(query, positions), rotate_by_time(key, positions)
        x = x + self.time.merge_heads(attention(query, key, value, time_mask)).transpose(1, 2)
        return self._condition_and_mlp(x, condition, condition_mask)

    def step(
        self, x: Tensor, condition: Tensor, condition_mask: Tensor | None, cache: TemporalCache, layer: int
    ) -> Tensor:
        """One new frame x (B, 1, S, D) against the ring; writes its own keys and values first."""
        x = self.attend_space(x)
        query, key, value = self.time.split_heads(x.transpose(1, 2))
        position = torch.full((1,), cache.position, device=x.device)
        slot = cache.position % cache.window
        cache.keys[layer, ..., slot : slot + 1, :] = rotate_by_time(key, position)
        cache.values[layer, ..., slot : slot + 1, :] = value
        mask = cache.slot_mask()
        past = cache.keys[layer, ..., : mask.shape[1], :], cache.values[layer, ..., : mask.shape[1], :]
        attended = attention(rotate_by_time(query, position), *past, mask[:, None, None, None, :])
        x = x + self.time.merge_heads(attended).transpose(1, 2)
        return self._condition_and_mlp(x, condition, condition_mask)

    def _condition_and_mlp(self, x: Tensor, condition: Tensor, mask: Tensor | None) -> Tensor:
        x = self.condition(x, condition, mask)
        return x + self.mlp(x)


class SpatialTemporalTransformer(nn.Module):
    """L blocks and a final norm over frames of S tokens of width D, remembering `window` frames."""

    def __init__(self, layers: int, width: int, heads: int, window: int) -> None:
        super().__init__()
        self.window = window
        self.width = width
        self.heads = heads
        self.blocks = nn.ModuleList(SpatialTemporalBlock(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor, condition: Tensor, condition_mask: Tensor | None = None) -> Tensor:
        """x (B, T, S, D) → (B, T, S, D); frame t sees frames t − window + 1 … t."""
        time_mask = banded_causal_mask(x.shape[1], self.window, x.device)
        for block in self.blocks:
            x = block(x, condition, condition_mask, time_mask)
        return self.norm(x)

    def make_cache(self, batch: int, tokens: int, device: torch.device, dtype: torch.dtype) -> TemporalCache:
        """An empty ring for `batch` environments of `tokens` tokens a frame."""
        shape = (len(self.blocks), batch, tokens, self.heads, self.window, self.width // self.heads)
        keys, values = (torch.zeros(shape, device=device, dtype=dtype) for _ in range(2))
        return TemporalCache(keys, values, torch.zeros(batch, dtype=torch.long, device=device))

    def step(
        self, x: Tensor, condition: Tensor, condition_mask: Tensor | None, cache: TemporalCache
    ) -> Tensor:
        """One frame x (B, 1, S, D) → (B, 1, S, D), in one pass; advances the ring."""
        for layer, block in enumerate(self.blocks):
            x = cast(SpatialTemporalBlock, block).step(x, condition, condition_mask, cache, layer)
        cache.position += 1
        return self.norm(x)
