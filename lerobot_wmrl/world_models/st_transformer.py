"""Spatial-temporal transformer: attention inside a frame, causal attention along time, condition, MLP.

Time positions are rotary and therefore relative: the window slides over rollouts of any length. Keys and
values of past frames live in a preallocated ring, so an imagined frame costs one frame's forward pass.
"""

from collections.abc import Callable
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import draw_own_rows
from lerobot_wmrl.world_models.attention import SelfAttention, attention
from lerobot_wmrl.world_models.conditioning import (
    Conditioning,
    ConditionTokens,
    CrossAttention,
    make_conditioning,
    pooled,
)
from lerobot_wmrl.world_models.temporal_memory import ClipMemory, TemporalCache, TemporalMemory

LayerHook = Callable[[int, Tensor], Tensor]
"""Takes a layer's index and output (B, T, S, D), and returns what the next layer is given."""


def unchanged(layer: int, x: Tensor) -> Tensor:
    """Hands every layer's output on as it is."""
    return x


def make_mlp(width: int) -> nn.Sequential:
    """Pre-norm and the MLP of a block."""
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
    )


class SpatialTemporalBlock(nn.Module):
    """Space, time, condition, MLP; each with pre-norm and a skip."""

    def __init__(self, width: int, heads: int, conditioning: str) -> None:
        super().__init__()
        self.space = SelfAttention(width, heads)
        self.time = SelfAttention(width, heads)
        self.condition = make_conditioning(conditioning, width, heads)
        self.mlp = make_mlp(width)

    def forward(
        self, x: Tensor, condition: ConditionTokens, attend_time: Callable[[Tensor, Tensor, Tensor], Tensor]
    ) -> Tensor:
        """x (B, T, S, D) → same; `attend_time` maps query, key and value (B, S, h, T, d) to the attended."""
        space, time, mlp = self.condition.branches(condition)
        heads = self.space.split_heads(space.enter(self.space.norm(x)))
        x = x + space.leave(self.space.merge_heads(attention(*heads)))
        heads = self.time.split_heads(time.enter(self.time.norm(x)).transpose(1, 2))
        x = x + time.leave(self.time.merge_heads(attend_time(*heads)).transpose(1, 2))
        x = self.condition(x, condition)
        norm, expand, activate, contract = self.mlp
        return x + mlp.leave(contract(activate(expand(mlp.enter(norm(x))))))


class SpatialBlock(nn.Module):
    """Space, condition, MLP."""

    def __init__(self, width: int, heads: int, conditioning: Conditioning) -> None:
        super().__init__()
        self.space = SelfAttention(width, heads)
        self.condition = conditioning
        self.mlp = make_mlp(width)

    def forward(self, x: Tensor, condition: ConditionTokens) -> Tensor:
        """x (B, T, S, D) → same."""
        x = x + self.space.merge_heads(attention(*self.space.split_heads(self.space.norm(x))))
        x = self.condition(x, condition)
        return x + self.mlp(x)


class Dropout(nn.Module):
    """Leaves out a share of what it is given, in training (Srivastava et al. 2014): of each row of the batch
    the same, however many processes share it."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: Tensor) -> Tensor:
        """(B, …) → same."""
        if not self.training or not self.share:
            return x
        kept = draw_own_rows(torch.rand, x.shape, x.device) >= self.share
        return x * kept / (1 - self.share)


class TrajectoryBlock(nn.Module):
    """Time, scene, MLP for one token a frame; training drops a share of what each adds (`dropout`)."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.dropout = Dropout(dropout)
        self.time = SelfAttention(width, heads)
        self.scene = CrossAttention(width, heads)
        self.mlp = make_mlp(width)

    def offered(self, scene: Tensor) -> Tensor:
        """What the scene's tokens (B, 1, M, D) offer this block. → (B, 1, 2, h, M, d)"""
        return self.scene.offer(scene)

    def forward(self, x: Tensor, offered: Tensor, layer: int, memory: TemporalMemory) -> Tensor:
        """x (B, 1, T, D) → same, given what `offered` makes of the scene."""
        heads = self.time.split_heads(self.time.norm(x))
        x = x + self.dropout(self.time.merge_heads(memory.attend(layer, *heads)))
        x = x + self.dropout(self.scene.ask(x, offered))
        return x + self.dropout(self.mlp(x))


class SpatialTemporalTransformer(nn.Module):
    """L blocks and a final norm over frames of S tokens of width D, remembering `window` frames.

    Its layers are those from `first_layer` on in a memory that it shares with another transformer.
    """

    def __init__(
        self, layers: int, width: int, heads: int, window: int, conditioning: str = "cross_attention",
        first_layer: int = 0,
    ) -> None:  # fmt: skip
        super().__init__()
        self.window, self.first_layer = window, first_layer
        self.heads = heads
        self.head_width = width // heads
        self.blocks = nn.ModuleList(SpatialTemporalBlock(width, heads, conditioning) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(
        self,
        x: Tensor,
        condition: Tensor,
        condition_mask: Tensor | None = None,
        memory: TemporalMemory | None = None,
        after_layer: LayerHook = unchanged,
    ) -> Tensor:
        """x (B, T, S, D) → (B, T, S, D).

        `memory` says what a frame sees along time; without one, frame t sees t − window + 1 … t of x.
        """
        memory = memory or self.clip_memory(x.shape[1], x.device)
        given = ConditionTokens(condition, condition_mask, pooled(condition, condition_mask))
        for layer, block in enumerate(self.blocks):
            attend_time = partial(memory.attend, self.first_layer + layer)
            x = after_layer(layer, block(x, given, attend_time))
        return self.norm(x)

    def step(
        self, x: Tensor, condition: Tensor, condition_mask: Tensor | None, cache: TemporalCache
    ) -> Tensor:
        """One frame x (B, 1, S, D) → (B, 1, S, D), in one pass; advances the ring."""
        return cast(Tensor, self(x, condition, condition_mask, cache.advance()))

    def clip_memory(self, length: int, device: torch.device) -> ClipMemory:
        """For one pass over clips of `length` frames."""
        return ClipMemory(length, self.window, self.head_width, device)

    def make_cache(
        self, batch: int, tokens: int, device: torch.device, dtype: torch.dtype, grows: bool | None = None,
        layers_beside: int = 0,
    ) -> TemporalCache:  # fmt: skip
        """An empty ring for `batch` environments of `tokens` tokens a frame.

        If it grows, attention skips slots that are still empty; if not, all steps are alike, which a CUDA
        graph needs. By default it grows on the CPU. `layers_beside`: those of a transformer that shares it.
        """
        shape = (len(self.blocks) + layers_beside, batch, tokens, self.heads, self.window, self.head_width)
        return TemporalCache.empty(shape, device, dtype, device.type == "cpu" if grows is None else grows)
