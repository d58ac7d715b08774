"""The autoregressive network: codes of frame t and a condition give frame t + 1 (eq. 1).

A spatial-temporal transformer: attention inside a frame, causal attention along time, condition, MLP. One
pass predicts every token of the next frame, the next proprioceptive state and whether success holds there.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.kv_cache import KVCache
from lerobot_wmrl.world_models.layers import (
    STATE_STEP,
    ClipMemory,
    CrossAttention,
    FrameNetwork,
    FrameSizes,
    Prediction,
    SelfAttention,
    TemporalMemory,
    attention,
    make_mlp,
)


class DepthPredictor(Protocol):
    """What the network asks of RoboScape's depth branch, if it has one."""

    def __call__(
        self, depth: Tensor | None, register: Tensor, condition: Condition, memory: TemporalMemory
    ) -> tuple[list[Tensor], Tensor]:
        """Return what it adds to the tokens after each layer, and the next frames' depth."""
        ...


class Modulation(NamedTuple):
    """How the condition modulates a branch of a block (space, time or MLP).

    scale, shift, gate: (B, T or 1, 1, D) each, zeros are the identity; None without modulation.
    """

    scale: Tensor | None = None
    shift: Tensor | None = None
    gate: Tensor | None = None

    def input(self, x: Tensor) -> Tensor:
        """Modulate what the branch sees, (B, T, S, D)."""
        return x if self.scale is None or self.shift is None else x * (1 + self.scale) + self.shift

    def output(self, x: Tensor) -> Tensor:
        """Modulate what the branch adds to the tokens, (B, T, S, D)."""
        return x if self.gate is None else x * (1 + self.gate)


class Conditioning(nn.Module):
    """How a block takes in the condition (eq. 1's c). This base ignores it.

    Subclasses modulate the block's three branches (space, time, MLP), change the tokens between time and MLP,
    or both. `mean` (B, T or 1, D) is that of the condition's tokens.
    """

    def modulations(self, mean: Tensor) -> tuple[Modulation, Modulation, Modulation]:
        """Return the modulations of space, time and MLP."""
        return Modulation(), Modulation(), Modulation()

    def forward(self, x: Tensor, condition: Condition, mean: Tensor) -> Tensor:
        """Condition the tokens (B, T, S, D) between time and MLP. → same"""
        return x


class CrossAttentionConditioning(Conditioning):
    """Tokens attend to the condition's (the paper's way)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attention = CrossAttention(width, heads)

    def forward(self, x: Tensor, condition: Condition, mean: Tensor) -> Tensor:
        keys_values = self.attention.project_kv(condition.tokens)
        return x + self.attention.cross_attend(x, keys_values, condition.mask)


class AdaptiveLayerNorm(Conditioning):
    """The condition's mean scales, shifts and gates the branches (Peebles & Xie 2023, adaLN).

    Zero-initialised around 1: the gates of their adaLN-Zero begin at 0, but here the attentions' output
    layers do already, and two zeros in a row would never learn.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.modulation = nn.Linear(width, 9 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def modulations(self, mean: Tensor) -> tuple[Modulation, Modulation, Modulation]:
        parts = self.modulation(nn.functional.silu(mean))[:, :, None].chunk(9, -1)
        return Modulation(*parts[:3]), Modulation(*parts[3:6]), Modulation(*parts[6:])


class AddedCondition(Conditioning):
    """The condition's mean, projected, is added to every token of its frame."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.project = nn.Linear(width, width)

    def forward(self, x: Tensor, condition: Condition, mean: Tensor) -> Tensor:
        return x + self.project(mean)[:, :, None]


CONDITIONING_CLASSES: Final[dict[str, type[Conditioning]]] = {
    "cross_attention": CrossAttentionConditioning,
    "adaln": AdaptiveLayerNorm,
    "additive": AddedCondition,
}


class SpatialTemporalBlock(nn.Module):
    """Space, time, condition, MLP; each with pre-norm and a skip."""

    def __init__(self, width: int, heads: int, conditioning: str) -> None:
        super().__init__()
        self.space = SelfAttention(width, heads)
        self.time = SelfAttention(width, heads)
        self.condition = CONDITIONING_CLASSES[conditioning](width, heads)
        self.mlp = make_mlp(width)

    def forward(
        self,
        x: Tensor,
        condition: Condition,
        mean: Tensor,
        attend_time: Callable[[Tensor, Tensor, Tensor], Tensor],
    ) -> Tensor:
        """x (B, T, S, D) → same; `attend_time` maps query, key and value (B, S, h, T, d) to the attended."""
        space, time, mlp = self.condition.modulations(mean)
        heads = self.space.split_heads(space.input(self.space.norm(x)))
        x = x + space.output(self.space.merge_heads(attention(*heads)))
        heads = self.time.split_heads(time.input(self.time.norm(x)).transpose(1, 2))
        x = x + time.output(self.time.merge_heads(attend_time(*heads)).transpose(1, 2))
        x = self.condition(x, condition, mean)
        norm, expand, activate, contract = self.mlp
        return x + mlp.output(contract(activate(expand(mlp.input(norm(x))))))


class SpatialTemporalTransformer(nn.Module):
    """L blocks and a final norm over frames of S tokens of width D.

    Two transformers may share a memory, where the layers of this one are numbered from `first_layer` on.
    """

    def __init__(self, layers: int, width: int, heads: int, conditioning: str, first_layer: int = 0) -> None:
        super().__init__()
        self.first_layer = first_layer
        self.blocks = nn.ModuleList(SpatialTemporalBlock(width, heads, conditioning) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(
        self,
        x: Tensor,
        condition: Condition,
        memory: TemporalMemory,
        added: Sequence[Tensor] = (),
        fusion: Sequence[nn.Module] = (),
    ) -> tuple[Tensor, list[Tensor]]:
        """Run the blocks.

        Args:
            x: tokens (B, T, S, D).
            condition: tokens (B, T or 1, M, D).
            memory: what a frame sees along time.
            added: for each layer, what joins the tokens after it; nothing by default.
            fusion: fusion for each layer, a projection of the tokens after it, for another transformer.

        Returns:
            Tokens (B, T, S, D), and the projections.
        """
        mean, projected = condition.mean(), []
        for layer, block in enumerate(self.blocks):
            x = block(x, condition, mean, partial(memory.attend, self.first_layer + layer))
            if fusion:
                projected.append(fusion[layer](x))
            if added:
                x = x + added[layer]
        return self.norm(x), projected


class NextFrameNetwork(FrameNetwork):
    """Embeds frames, runs the transformer, reads the predictions from its tokens, done and the next state
    from the register.
    """

    def __init__(self, config: AutoregressiveConfig, sizes: FrameSizes) -> None:
        super().__init__(sizes, patch=config.patch, width=config.width, code_width=config.code_width)
        width, state_size = config.width, sizes.state_size
        self.window, self.heads, self.head_width = config.window, config.heads, width // config.heads
        self.state_out = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, state_size))
        self.transformer = SpatialTemporalTransformer(config.layers, width, config.heads, config.conditioning)
        self.depth: DepthPredictor | None = None  # set by the dynamics, if configured

    def forward(
        self,
        codes: Tensor,
        state: Tensor,
        condition: Condition,
        memory: TemporalMemory | None = None,
        depth: Tensor | None = None,
    ) -> tuple[Prediction, Tensor]:
        """Predict the frame after each of T frames.

        Args:
            codes: (B, T, S, C).
            state: (B, T, P), normalised.
            condition: tokens (B, T or 1, M, D).
            memory: what frames see along time; without one, frame t sees t − window + 1 … t of the clip.
            depth: (B, T, S), normalised, if there is a depth branch.

        Returns:
            The prediction and the next frames' depth (B, T, S), normalised; (B, T, 0) without a branch.
        """
        memory = memory or self.clip_memory(codes.shape[1], codes.device)
        x, local = self.embed(codes, state, condition.mean())
        added, next_depth = self.predict_depth(depth, x[:, :, :1], condition, memory)
        x, _ = self.transformer(x, condition, memory, added)
        logits, hidden = self.token_logits(x, local, codes), x[:, :, 0].float()
        with compute_in(torch.float32, x.device):
            next_state = state + STATE_STEP * self.state_out(hidden)
            return Prediction(logits, self.done(hidden).squeeze(-1), next_state, hidden), next_depth

    def predict_depth(
        self, depth: Tensor | None, register: Tensor, condition: Condition, memory: TemporalMemory
    ) -> tuple[list[Tensor], Tensor]:
        """Run the depth branch, if there is one.

        Returns:
            What it adds to the tokens after each layer, and the next frames' depth (B, T, S or 0).
        """
        if self.depth is None:
            return [], register.new_zeros(*register.shape[:2], 0)
        return self.depth(depth, register, condition, memory)

    def clip_memory(self, length: int, device: torch.device) -> ClipMemory:
        """Return the memory of one pass over clips of `length` frames."""
        return ClipMemory(length, self.window, self.head_width, device)

    def make_cache(
        self, batch: int, device: torch.device, dtype: torch.dtype, grows: bool | None = None
    ) -> KVCache:
        """Return an empty KV cache for `batch` environments; the depth branch's layers follow the tokens'."""
        layers = len(self.transformer.blocks) * (1 if self.depth is None else 2)
        shape = (layers, batch, self.tokens_per_frame, self.heads, self.window, self.head_width)
        return KVCache.empty(shape, device, dtype, grows)
