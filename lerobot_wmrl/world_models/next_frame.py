"""The autoregressive network: tokens of frame t and a condition give frame t + 1 (eq. 1).

One pass predicts every token of the next frame (shifted prediction), the next proprioceptive state, whether
success holds there and, on request, the next depth.
"""

from typing import Any

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.conditioning import pooled
from lerobot_wmrl.world_models.depth_branch import DepthBranch, NoDepth
from lerobot_wmrl.world_models.frame_network import STATE_STEP, FrameNetwork, Prediction
from lerobot_wmrl.world_models.st_transformer import SpatialTemporalTransformer
from lerobot_wmrl.world_models.temporal_memory import TemporalCache, TemporalMemory


class NextFrameNetwork(FrameNetwork):
    """Embeds frames, runs the transformer, reads the three predictions.

    A register token a frame carries the proprioceptive state and the mean of the condition, looks at all
    visual tokens, and is where done and the next state are read from.

    Args:
        layers, heads, window: of the transformer. conditioning: how its blocks take in the condition.
        depth: whether depth is seen and predicted beside the tokens. Others as in `FrameNetwork`.
    """

    def __init__(
        self, *, layers: int, heads: int, window: int, conditioning: str = "cross_attention",
        depth: bool = False, **sizes: Any,
    ) -> None:  # fmt: skip
        super().__init__(**sizes)
        width, state_size = sizes["width"], sizes["state_size"]
        self.state_out = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, state_size))
        self.transformer = SpatialTemporalTransformer(layers, width, heads, window, conditioning)
        self.depth = NoDepth()
        if depth:
            self.depth = DepthBranch(
                grid=self.grid, num_cameras=self.num_cameras, patch=self.patch, layers=layers, width=width,
                heads=heads, window=window, code_width=sizes["code_width"], conditioning=conditioning,
            )  # fmt: skip

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
        depth: Tensor | None = None, context: Context = NO_CONTEXT,
    ) -> Prediction:  # fmt: skip
        """The same for one new frame (T = 1) against the cache; the context is not looked at."""
        prediction: Prediction = self(digits, state, condition, mask, cache.advance(), depth)
        return prediction

    def make_cache(
        self, batch: int, device: torch.device, dtype: torch.dtype, grows: bool | None = None
    ) -> TemporalCache:
        """An empty ring for `batch` environments, as `SpatialTemporalTransformer.make_cache` has it."""
        return self.transformer.make_cache(
            batch, self.transformer_tokens, device, dtype, grows, self.depth.layers
        )

    def _read(self, x: Tensor, local: Tensor, digits: Tensor, state: Tensor, depth: Tensor) -> Prediction:
        logits, hidden = self.token_logits(x, local, digits), x[:, :, 0].float()
        with compute_in(torch.float32, x.device):
            next_state = state + STATE_STEP * self.state_out(hidden)
            return Prediction(logits, self.done(hidden).squeeze(-1), next_state, hidden, depth)
