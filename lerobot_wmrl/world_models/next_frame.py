"""The network both world models share: tokens of frame t and a condition give frame t + 1 (eq. 1).

One pass predicts every token of the next frame (shifted prediction), the next proprioceptive state and
whether success holds there. What is read from the transformer is read in float32.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.precision import compute_in
from lerobot_wmrl.world_models.codebook import make_codebook
from lerobot_wmrl.world_models.conditioning import pooled
from lerobot_wmrl.world_models.st_transformer import SpatialTemporalTransformer
from lerobot_wmrl.world_models.temporal_memory import TemporalCache, TemporalMemory

STATE_STEP = 0.1
"""The state head predicts changes in units of a tenth of the state's spread."""


class Prediction(NamedTuple):
    """About frame t + 1, given frames up to t. V is the sum of the levels of all factors.

    logits (B, T, S, V); done_logit (B, T); proprioception (B, T, P) in normalised units; hidden (B, T, D).
    """

    logits: Tensor
    done_logit: Tensor
    proprioception: Tensor
    hidden: Tensor


class FrameEmbedding(nn.Module):
    """Code grids to transformer tokens: a 3x3 convolution, then non-overlapping patches of the grid."""

    def __init__(self, channels: int, grid: int, patch: int, code_width: int, width: int) -> None:
        super().__init__()
        self.local = nn.Conv2d(channels, code_width, 3, padding=1)
        self.patches = nn.Conv2d(code_width, width, patch, stride=patch)
        self.position = nn.Parameter(torch.randn((grid // patch) ** 2, width) * 0.02)

    def forward(self, values: Tensor, mark: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """values (F, K, g, g) → tokens (F, (g/patch)², D) and the local features (F, code_width, g, g).

        `mark` (F, code_width, g, g) says what else is known about the values.
        """
        local = self.local(values)
        local = F.silu(local if mark is None else local + mark)
        return self.patches(local).flatten(2).transpose(1, 2) + self.position, local


class FrameHead(nn.Module):
    """Transformer tokens back to the code grid: logits of each factor, biased towards staying the same."""

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


class NextFrameNetwork(nn.Module):
    """Embeds frames, runs the transformer, reads the three predictions.

    A register token a frame carries the proprioceptive state and the mean of the condition, looks at all
    visual tokens, and is where done and the next state are read from.

    Args:
        levels: codes of each factor. quantizer: what they stand for, `fsq` or `lfq`.
        grid: side of a camera's token grid. num_cameras: grids a frame.
        state_size: P, 0 without proprioception. patch: side of the token patches that form one
        transformer token. conditioning: how blocks take in the condition.
    """

    def __init__(
        self, *, levels: Sequence[int], grid: int, num_cameras: int, state_size: int, patch: int,
        layers: int, width: int, heads: int, window: int, code_width: int,
        conditioning: str = "cross_attention", quantizer: str = "fsq",
    ) -> None:  # fmt: skip
        super().__init__()
        self.codebook = make_codebook(quantizer, levels)
        self.grid, self.num_cameras, self.patch = grid, num_cameras, patch
        self.embedding = FrameEmbedding(self.codebook.channels, grid, patch, code_width, width)
        self.camera = nn.Parameter(torch.randn(num_cameras, 1, width) * 0.02)
        self.register = nn.Parameter(torch.randn(width) * 0.02)
        self.state_in = nn.Linear(state_size, width)
        self.transformer = SpatialTemporalTransformer(layers, width, heads, window, conditioning)
        self.head = FrameHead(len(levels), sum(levels), patch, code_width, width)
        self.done = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1))
        self.state_out = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, state_size))

    @property
    def transformer_tokens(self) -> int:
        """Tokens a frame inside the transformer, the register included."""
        return self.num_cameras * (self.grid // self.patch) ** 2 + 1

    def forward(
        self,
        digits: Tensor,
        state: Tensor,
        condition: Tensor,
        mask: Tensor | None = None,
        memory: TemporalMemory | None = None,
    ) -> Prediction:
        """Teacher-forced pass. digits (B, T, S, C), state (B, T, P), condition (B, T or 1, M, D)."""
        x, local = self.embed(digits, state, pooled(condition, mask))
        return self._read(self.transformer(x, condition, mask, memory), local, digits, state)

    def step(
        self, digits: Tensor, state: Tensor, condition: Tensor, mask: Tensor | None, cache: TemporalCache
    ) -> Prediction:
        """The same for one new frame (T = 1) against the cache."""
        x, local = self.embed(digits, state, pooled(condition, mask))
        return self._read(self.transformer.step(x, condition, mask, cache), local, digits, state)

    def grids(self, per_token: Tensor) -> Tensor:
        """(B, T, S, K) → (B·T·N, K, g, g)."""
        grids = per_token.unflatten(2, (self.num_cameras, self.grid, self.grid))
        return grids.flatten(0, 2).permute(0, 3, 1, 2)

    def embed(
        self, digits: Tensor, state: Tensor, condition: Tensor, mark: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Digits, state and the condition's mean (B, T or 1, D) → transformer tokens (B, T, 1 + S', D) and
        local features. `mark` as in `FrameEmbedding`."""
        batch, time = digits.shape[:2]
        tokens, local = self.embedding(self.grids(self.codebook.values(digits)), mark)
        tokens = tokens.unflatten(0, (batch, time, self.num_cameras)) + self.camera
        register = (self.register + self.state_in(state) + condition)[:, :, None]
        return torch.cat([register, tokens.flatten(2, 3)], 2), local

    def token_logits(self, x: Tensor, local: Tensor, digits: Tensor) -> Tensor:
        """The transformer's output (B, T, 1 + S', D) → logits (B, T, S, V), biased towards `digits`."""
        frames = x[:, :, 1:].unflatten(2, (self.num_cameras, -1)).flatten(0, 2)
        logits, gate = (self._per_token(grids.float(), digits) for grids in self.head(frames, local))
        return logits + gate[..., self.codebook.factor_of_logit] * self.codebook.one_hot(digits)

    def _read(self, x: Tensor, local: Tensor, digits: Tensor, state: Tensor) -> Prediction:
        logits, hidden = self.token_logits(x, local, digits), x[:, :, 0].float()
        with compute_in(torch.float32, x.device):
            next_state = state + STATE_STEP * self.state_out(hidden)
            return Prediction(logits, self.done(hidden).squeeze(-1), next_state, hidden)

    def _per_token(self, grids: Tensor, digits: Tensor) -> Tensor:
        """(B·T·N, K, g, g) → (B, T, S, K)."""
        return grids.permute(0, 2, 3, 1).reshape(*digits.shape[:3], -1)
