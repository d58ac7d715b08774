"""What a world model's network has in common whatever imagines: frames in, and predictions out.

Tokens of frames and robot states become transformer tokens; what a transformer makes of them is read as the
codes of a frame, done and the next state. What is read from the transformer is read in float32.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.codebook import make_codebook
from lerobot_wmrl.world_models.depth_branch import NoDepth
from lerobot_wmrl.world_models.frame_grids import FrameEmbedding, FrameHead
from lerobot_wmrl.world_models.temporal_memory import FrameCache

STATE_STEP = 0.1
"""State heads predict changes in units of a tenth of the state's spread."""


class Prediction(NamedTuple):
    """About frame t + 1, given frames up to t. V is the sum of the levels of all factors.

    logits (B, T, S, V), or (B, K, S, V) if K frames were asked for; done_logit (B, T); proprioception
    (B, T, P) in normalised units; hidden (B, T, D); depth (B, T, S) as the depth branch scales it,
    (B, T, 0) without one.
    """

    logits: Tensor
    done_logit: Tensor
    proprioception: Tensor
    hidden: Tensor
    depth: Tensor


class FrameNetwork(nn.Module):
    """Embeds frames and reads what a transformer thinks of them; subclasses have the transformer.

    Args:
        levels: codes of each factor. quantizer: what they stand for, `fsq` or `lfq`.
        grid: side of a camera's token grid. num_cameras: grids a frame.
        state_size: P, 0 without proprioception. patch: side of the token patches that form one
        transformer token. code_width, width: channels on the token grid and inside the transformer.
    """

    depth: NoDepth

    def __init__(
        self, *, levels: Sequence[int], grid: int, num_cameras: int, state_size: int, patch: int,
        width: int, code_width: int, quantizer: str = "fsq",
    ) -> None:  # fmt: skip
        super().__init__()
        self.codebook = make_codebook(quantizer, levels)
        self.grid, self.num_cameras, self.patch = grid, num_cameras, patch
        self.embedding = FrameEmbedding(self.codebook.channels, grid, patch, code_width, width)
        self.camera = nn.Parameter(torch.randn(num_cameras, 1, width) * 0.02)
        self.register = nn.Parameter(torch.randn(width) * 0.02)
        self.state_in = nn.Linear(state_size, width)
        self.head = FrameHead(len(levels), sum(levels), patch, code_width, width)
        self.done = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1))

    @property
    def transformer_tokens(self) -> int:
        """Tokens a frame inside the transformer, the register included."""
        return self.num_cameras * (self.grid // self.patch) ** 2 + 1

    def grids(self, per_token: Tensor) -> Tensor:
        """(B, T, S, K) → (B·T·N, K, g, g)."""
        grids = per_token.unflatten(2, (self.num_cameras, self.grid, self.grid))
        return grids.flatten(0, 2).permute(0, 3, 1, 2)

    def embed(
        self, digits: Tensor, state: Tensor, condition: Tensor | float, mark: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Digits, state and the condition's mean (B, T or 1, D) → transformer tokens (B, T, 1 + S', D) and
        local features (B·T·N, code_width, g, g). `mark` as in `FrameEmbedding`."""
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

    def step(
        self, digits: Tensor, state: Tensor, condition: Tensor, mask: Tensor | None, cache: Any,
        depth: Tensor | None = None, context: Context = NO_CONTEXT,
    ) -> Prediction:  # fmt: skip
        """About the frame after the newest one (T = 1), given what the network's own `cache` remembers, and,
        where a network looks at them, depth (B, 1, S) and the context of B first frames."""
        raise NotImplementedError

    def make_cache(self, batch: int, device: torch.device, dtype: torch.dtype) -> FrameCache:
        """Of `batch` imaginations that have not begun."""
        raise NotImplementedError

    def _per_token(self, grids: Tensor, digits: Tensor) -> Tensor:
        """(B·T·N, K, g, g) → (B, T, S, K)."""
        return grids.permute(0, 2, 3, 1).reshape(*digits.shape[:3], -1)
