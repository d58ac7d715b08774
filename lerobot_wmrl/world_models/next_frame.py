"""The network both world models share: tokens of frame t and a condition give frame t + 1 (eq. 1).

One pass predicts every token of the next frame (shifted prediction), the next proprioceptive state, whether
success holds there and, on request, the next depth. What is read from the transformer is read in float32.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lerobot_wmrl.precision import compute_in
from lerobot_wmrl.world_models.codebook import make_codebook
from lerobot_wmrl.world_models.conditioning import pooled
from lerobot_wmrl.world_models.depth_branch import DepthBranch, NoDepth
from lerobot_wmrl.world_models.frame_grids import FrameEmbedding, FrameHead
from lerobot_wmrl.world_models.st_transformer import SpatialTemporalTransformer
from lerobot_wmrl.world_models.temporal_memory import TemporalCache, TemporalMemory

STATE_STEP = 0.1
"""The state head predicts changes in units of a tenth of the state's spread."""


class Prediction(NamedTuple):
    """About frame t + 1, given frames up to t. V is the sum of the levels of all factors.

    logits (B, T, S, V); done_logit (B, T); proprioception (B, T, P) in normalised units; hidden (B, T, D);
    depth (B, T, S) as the depth branch scales it, (B, T, 0) without one.
    """

    logits: Tensor
    done_logit: Tensor
    proprioception: Tensor
    hidden: Tensor
    depth: Tensor


class NextFrameNetwork(nn.Module):
    """Embeds frames, runs the transformer, reads the three predictions.

    A register token a frame carries the proprioceptive state and the mean of the condition, looks at all
    visual tokens, and is where done and the next state are read from.

    Args:
        levels: codes of each factor. quantizer: what they stand for, `fsq` or `lfq`.
        grid: side of a camera's token grid. num_cameras: grids a frame.
        state_size: P, 0 without proprioception. patch: side of the token patches that form one
        transformer token. conditioning: how blocks take in the condition. depth: whether depth is seen and
        predicted beside the tokens.
    """

    def __init__(
        self, *, levels: Sequence[int], grid: int, num_cameras: int, state_size: int, patch: int,
        layers: int, width: int, heads: int, window: int, code_width: int,
        conditioning: str = "cross_attention", quantizer: str = "fsq", depth: bool = False,
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
        self.depth: NoDepth = NoDepth()
        if depth:
            self.depth = DepthBranch(
                grid=grid, num_cameras=num_cameras, patch=patch, layers=layers, width=width, heads=heads,
                window=window, code_width=code_width, conditioning=conditioning,
            )  # fmt: skip

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
        depth: Tensor | None = None,
    ) -> Prediction:
        """Teacher-forced pass. digits (B, T, S, C), state (B, T, P), condition (B, T or 1, M, D), depth
        (B, T, S) where the network looks at it."""
        memory = memory or self.transformer.clip_memory(digits.shape[1], digits.device)
        x, local = self.embed(digits, state, pooled(condition, mask))
        fuse, next_depth = self.depth(depth, x[:, :, :1], condition, mask, memory)
        x = self.transformer(x, condition, mask, memory, fuse)
        return self._read(x, local, digits, state, next_depth)

    def step(
        self, digits: Tensor, state: Tensor, condition: Tensor, mask: Tensor | None, cache: TemporalCache,
        depth: Tensor | None = None,
    ) -> Prediction:  # fmt: skip
        """The same for one new frame (T = 1) against the cache."""
        prediction: Prediction = self(digits, state, condition, mask, cache.advance(), depth)
        return prediction

    def make_cache(
        self, batch: int, device: torch.device, dtype: torch.dtype, grows: bool | None = None
    ) -> TemporalCache:
        """An empty ring for `batch` environments, as `SpatialTemporalTransformer.make_cache` has it."""
        return self.transformer.make_cache(
            batch, self.transformer_tokens, device, dtype, grows, self.depth.layers
        )

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

    def _read(self, x: Tensor, local: Tensor, digits: Tensor, state: Tensor, depth: Tensor) -> Prediction:
        logits, hidden = self.token_logits(x, local, digits), x[:, :, 0].float()
        with compute_in(torch.float32, x.device):
            next_state = state + STATE_STEP * self.state_out(hidden)
            return Prediction(logits, self.done(hidden).squeeze(-1), next_state, hidden, depth)

    def _per_token(self, grids: Tensor, digits: Tensor) -> Tensor:
        """(B·T·N, K, g, g) → (B, T, S, K)."""
        return grids.permute(0, 2, 3, 1).reshape(*digits.shape[:3], -1)
