"""Parts of both kinds of dynamics: condition and prediction, attention, embedding and reading of frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.world_models.codebook import make_codebook
from lerobot_wmrl.world_models.success import PredictedSuccess

STATE_STEP: Final = 0.1
"""State heads predict changes in units of a tenth of the state's standard deviation."""


def attention(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(Q·Kᵀ/√d)·V with plain matmuls, which beat fused kernels at these sizes on the CPU.

    query (…, h, Q, d), key and value (…, h, K, d), mask broadcastable to (…, h, Q, K), True = attend.
    """
    scores = query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
    if mask is not None:
        scores = scores.masked_fill(~mask, float("-inf"))
    return scores.softmax(-1) @ value


class Rotation(NamedTuple):
    """Rotary embedding (Su et al. 2021) of T positions: cos and sin (T, d/2) of the angles.

    Positions are relative in the products of queries and keys, so a window can slide over a rollout of any
    length.
    """

    cos: Tensor
    sin: Tensor

    @classmethod
    def at(cls, positions: Tensor, head_width: int) -> "Rotation":
        """Return the rotation of positions (T,), on their device."""
        half = head_width // 2
        frequencies = 1000.0 ** (-torch.arange(half, device=positions.device) / half)
        angles = positions[:, None].float() * frequencies
        return cls(angles.cos(), angles.sin())

    def __call__(self, x: Tensor) -> Tensor:
        """Rotate queries or keys. (…, T, d) → (…, T, d)"""
        cos, sin = self.cos.to(x.dtype), self.sin.to(x.dtype)
        a, b = x.chunk(2, -1)
        return torch.cat([a * cos - b * sin, a * sin + b * cos], -1)


class Prediction(NamedTuple):
    """Predictions of frame t + 1 for each of T frames.

    logits (B, T, S, V), V the sum of the levels of all factors, or (B, K, S, V) if only K frames were asked
    for; done_logit (B, T); state (B, T, P), normalised; hidden (B, T, D).
    """

    logits: Tensor
    done_logit: Tensor
    state: Tensor
    hidden: Tensor


class TemporalMemory(Protocol):
    """Attention along time, layer by layer: within a clip in training, to a KV cache in imagination."""

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend to the frames that each frame may see. (B, S, h, T, d) each → (B, S, h, T, d)"""


class ClipMemory:
    """Causal attention within a clip: frame t sees frames t − window + 1 … t."""

    def __init__(self, length: int, window: int, head_width: int, device: torch.device) -> None:
        self.positions, self.head_width = torch.arange(length, device=device), head_width
        self.rotation = Rotation.at(self.positions, head_width)
        lag = self.positions[:, None] - self.positions[None, :]
        self.mask = (lag >= 0) & (lag < window)  # (T, T)
        self.keys_values: dict[int, tuple[Tensor, Tensor]] = {}

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend, and keep the layer's keys and values (B, S, h, T, d), which MaskGIT reads."""
        query, key = self.rotation(query), self.rotation(key)
        self.keys_values[layer] = key, value
        return attention(query, key, value, self.mask)


class SelfAttention(nn.Module):
    """Projections of multi-head self-attention with pre-norm, over space or over time."""

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


class CrossAttention(nn.Module):
    """Multi-head attention, with pre-norm, to tokens whose keys and values can be computed beforehand."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width, bias=False)
        self.key_value = nn.Linear(width, 2 * width, bias=False)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.bias)

    def project_kv(self, tokens: Tensor) -> Tensor:
        """Keys and values of tokens (B, T or 1, M, D). → (B, T or 1, 2, h, M, d)"""
        return self.key_value(tokens).unflatten(-1, (2, self.heads, -1)).movedim(-4, -2)

    def cross_attend(self, x: Tensor, keys_values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return what is added to x (B, T, S, D), of the same shape."""
        query = self.query(self.norm(x)).unflatten(-1, (self.heads, -1)).transpose(-2, -3)
        key, value = keys_values.unbind(-4)
        return self.out(attention(query, key, value, mask).transpose(-2, -3).flatten(-2))


def make_mlp(width: int) -> nn.Sequential:
    """Return a block's MLP, with pre-norm."""
    return nn.Sequential(
        nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
    )


class FrameEmbedding(nn.Module):
    """Code grids to transformer tokens: a 3x3 convolution, then non-overlapping patches of the grid."""

    def __init__(self, channels: int, grid: int, patch: int, code_width: int, width: int) -> None:
        super().__init__()
        self.local = nn.Conv2d(channels, code_width, 3, padding=1)
        self.patches = nn.Conv2d(code_width, width, patch, stride=patch)
        self.position = nn.Parameter(torch.randn((grid // patch) ** 2, width) * 0.02)

    def forward(self, values: Tensor, mark: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """values (F, K, g, g) → tokens (F, (g/patch)², D) and the local features (F, code_width, g, g).

        `mark` (F, code_width, g, g) is added to the local features before their activation.
        """
        local = self.local(values)
        local = F.silu(local if mark is None else local + mark)
        return self.patches(local).flatten(2).transpose(1, 2) + self.position, local


class FrameHead(nn.Module):
    """Transformer tokens to logits on the code grid, and gates that bias each factor to its present code."""

    def __init__(self, factors: int, logits: int, patch: int, code_width: int, width: int) -> None:
        super().__init__()
        self.patch = patch
        self.split = (logits, factors)
        self.up = nn.Linear(width, patch**2 * code_width)
        self.mix = nn.Conv2d(2 * code_width, code_width, 3, padding=1)
        self.out = nn.Conv2d(code_width, logits + factors, 1)

    def forward(self, hidden: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
        """hidden (F, (g/patch)², D), local (F, code_width, g, g) → logits (F, V, g, g), gate (F, C, g, g)."""
        size = local.shape[-1] // self.patch
        up = F.pixel_shuffle(self.up(hidden).transpose(1, 2).unflatten(2, (size, size)), self.patch)
        mixed = F.silu(self.mix(torch.cat([up, local], 1)))
        logits, gate = self.out(mixed).split(self.split, 1)
        return logits, F.softplus(gate)


@dataclass(frozen=True)
class FrameSizes:
    """Sizes of the frames that a network predicts.

    Args:
        levels: codes of each factor of a token.
        quantizer: what the codes stand for, `fsq` or `lfq`.
        grid: side of a camera's token grid.
        num_cameras: grids a frame, N.
        state_size: components of the proprioceptive state, P; 0 without.
        clip_length: frames of a training clip.
        context_channels: channels of the coarsest features of the tokenizer's context; 0 without.
        success: whether done is read from predicted features of the tokenizer's success classifier.
    """

    levels: Sequence[int]
    quantizer: str
    grid: int
    num_cameras: int
    state_size: int
    clip_length: int
    context_channels: int = 0
    success: bool = False


class FrameNetwork(nn.Module):
    """Embeds frames and reads codes and done from transformer tokens; subclasses add the transformer.

    A frame is one register token, which carries the state and the condition's mean, and the tokens of its
    patches.
    """

    def __init__(self, sizes: FrameSizes, *, patch: int, width: int, code_width: int) -> None:
        super().__init__()
        self.codebook = make_codebook(sizes.quantizer, sizes.levels)
        self.grid, self.num_cameras, self.patch = sizes.grid, sizes.num_cameras, patch
        self.embedding = FrameEmbedding(self.codebook.channels, sizes.grid, patch, code_width, width)
        self.camera = nn.Parameter(torch.randn(sizes.num_cameras, 1, width) * 0.02)
        self.register = nn.Parameter(torch.randn(width) * 0.02)
        self.state_in = nn.Linear(sizes.state_size, width)
        self.head = FrameHead(len(sizes.levels), sum(sizes.levels), patch, code_width, width)
        self.done: nn.Module = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1))
        if sizes.success:
            self.done = PredictedSuccess(width, sizes.num_cameras)

    @property
    def tokens_per_frame(self) -> int:
        """Transformer tokens a frame, 1 + S', the register included."""
        return self.num_cameras * (self.grid // self.patch) ** 2 + 1

    def grids(self, per_token: Tensor) -> Tensor:
        """(B, T, S, K) → (B·T·N, K, g, g)."""
        grids = per_token.unflatten(2, (self.num_cameras, self.grid, self.grid))
        return grids.flatten(0, 2).permute(0, 3, 1, 2)

    def embed(
        self, codes: Tensor, state: Tensor, condition: Tensor | float, mark: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Turn frames into transformer tokens.

        Args:
            codes: (B, T, S, C).
            state: (B, T, P), normalised.
            condition: its mean (B, T or 1, D).
            mark: as in `FrameEmbedding`.

        Returns:
            Transformer tokens (B, T, 1 + S', D) and local features (B·T·N, code_width, g, g).
        """
        batch, time = codes.shape[:2]
        tokens, local = self.embedding(self.grids(self.codebook.values(codes)), mark)
        tokens = tokens.unflatten(0, (batch, time, self.num_cameras)) + self.camera
        register = (self.register + self.state_in(state) + condition)[:, :, None]
        return torch.cat([register, tokens.flatten(2, 3)], 2), local

    def token_logits(self, x: Tensor, local: Tensor, codes: Tensor) -> Tensor:
        """The transformer's output (B, T, 1 + S', D) → logits (B, T, S, V), biased towards `codes`."""
        frames = x[:, :, 1:].unflatten(2, (self.num_cameras, -1)).flatten(0, 2)
        logits, gate = (self._per_token(grids.float(), codes) for grids in self.head(frames, local))
        return logits + gate[..., self.codebook.factor_of_logit] * self.codebook.one_hot(codes)

    def _per_token(self, grids: Tensor, codes: Tensor) -> Tensor:
        """(B·T·N, K, g, g) → (B, T, S, K)."""
        return grids.permute(0, 2, 3, 1).reshape(*codes.shape[:3], -1)
