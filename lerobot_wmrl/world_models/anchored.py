"""The anchored network: a clip's first frame and all that was done since give its frame t + 1 (eq. 1).

Four parts. The scene is the first frame, encoded once. The path is where the robot gets to in it, action by
action. The trajectory, one token a frame, follows the path through the scene; done is read from it. The
renderer draws any frame asked for, from the scene and the trajectory's token. No imagined frame is looked at
again, so errors in pictures do not add up, training meets what imagination meets, and it need not draw every
frame that it learns from.
"""

from collections.abc import Iterable
from typing import Any, cast

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.data.clips import take_rows
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.conditioning import AddedCondition, Conditioning, ConditionTokens, pooled
from lerobot_wmrl.world_models.depth_branch import NoDepth
from lerobot_wmrl.world_models.frame_grids import ContextEmbedding
from lerobot_wmrl.world_models.frame_network import FrameNetwork, Prediction
from lerobot_wmrl.world_models.path import Path, PathNetwork, Places
from lerobot_wmrl.world_models.scene import AnchoredCache, Scene
from lerobot_wmrl.world_models.st_transformer import SpatialBlock, TrajectoryBlock
from lerobot_wmrl.world_models.temporal_memory import ClipMemory, TemporalCache, TemporalMemory


class AnchoredNetwork(FrameNetwork):
    """Encodes a clip's first frame, follows the trajectory through it, draws the frames after it.

    Args:
        layers: of the trajectory and of the renderer; the scene's encoder has half as many.
        context_channels: of the coarsest features of the tokenizer's context, 0 without.
        dropout: in the trajectory, in training.
        heads, window: of the attention; `window` is the longest trajectory. Others as in `FrameNetwork`.
    """

    def __init__(
        self, *, layers: int, heads: int, window: int, context_channels: int = 0, dropout: float = 0.0,
        **sizes: Any,
    ) -> None:  # fmt: skip
        super().__init__(**sizes)
        width = sizes["width"]
        self.window, self.heads, self.head_width = window, heads, width // heads
        self.path = PathNetwork(sizes["state_size"], width)
        self.context = ContextEmbedding(context_channels, self.patch, width) if context_channels else None
        self.scene = nn.ModuleList(
            SpatialBlock(width, heads, Conditioning(width, heads)) for _ in range(max(1, layers // 2))
        )
        self.trajectory = nn.ModuleList(TrajectoryBlock(width, heads, dropout) for _ in range(layers))
        self.motion = nn.Linear(width, width)
        self.renderer = nn.ModuleList(
            SpatialBlock(width, heads, AddedCondition(width, heads)) for _ in range(layers)
        )
        self.places = Places(self.transformer_tokens, width)
        self.scene_norm, self.norm, self.drawn_norm = (nn.LayerNorm(width) for _ in range(3))
        self.depth = NoDepth()

    def forward(
        self,
        digits: Tensor,
        state: Tensor,
        condition: Tensor,
        mask: Tensor | None = None,
        *,
        length: int,
        frames: Tensor | None = None,
        context: Context = NO_CONTEXT,
    ) -> Prediction:
        """`length` frames T at once, from first digits (B, 1, S, C), first state (B, 1, P) and condition
        (B, T or 1, M, D). Logits are of the frames after rows `frames` (B, K), by default after all."""
        memory = ClipMemory(length, self.window, self.head_width, digits.device)
        mean = pooled(condition, mask).expand(-1, length, -1)
        return self._follow(*self.encode(digits, state, context), mean, memory, frames)[0]

    def step(
        self, digits: Tensor, state: Tensor, condition: Tensor, mask: Tensor | None, cache: AnchoredCache,
        depth: Tensor | None = None, context: Context = NO_CONTEXT,
    ) -> Prediction:  # fmt: skip
        """One frame more (T = 1) than the cache holds; what was seen is looked at where one begins."""
        rows = cache.due()
        if len(rows):
            cache.begin(rows, *self.encode(digits[rows], state[rows], context[rows]))
        assert cache.scene is not None
        assert cache.path is not None
        mean = pooled(condition, mask)
        prediction, path = self._follow(cache.scene, cache.path, mean, cache.advance(), None)
        cache.path = path.end()
        return prediction

    def encode(self, digits: Tensor, state: Tensor, context: Context) -> tuple[Scene, Path]:
        """First frames' digits (B, 1, S, C), states (B, 1, P) and their episodes' context.

        ValueError if that is missing.
        """
        x, local = self.embed(digits, state, 0.0)
        if self.context is not None:
            if len(context) != len(digits):
                raise ValueError(
                    f"the context of {len(context)} first frames for {len(digits)} imaginations: this world "
                    "model needs one each; give what its tokenizer's `context` returns"
                )
            x = torch.cat([x[:, :, :1], x[:, :, 1:] + self.context(context.features)[:, None]], 2)
        nothing = ConditionTokens(x[:, :, :1], None, x[:, :, 0])
        for block in self.scene:
            x = block(x, nothing)
        tokens = self.scene_norm(x)
        blocks = cast(Iterable[TrajectoryBlock], self.trajectory)
        offered = torch.stack([block.offered(tokens) for block in blocks], 2)
        local = local.unflatten(0, (len(digits), -1))
        return Scene(digits, tokens, offered, self.places(tokens), local), self.path.begin(state)

    def make_cache(self, batch: int, device: torch.device, dtype: torch.dtype) -> AnchoredCache:
        """Imaginations of which none has begun."""
        shape = (len(self.trajectory), batch, 1, self.heads, self.window, self.head_width)
        return AnchoredCache(TemporalCache.empty(shape, device, dtype, device.type == "cpu"))

    def _follow(
        self, scene: Scene, begin: Path, mean: Tensor, memory: TemporalMemory, frames: Tensor | None
    ) -> tuple[Prediction, Path]:
        """The trajectory under the conditions' means (B, T, D), and what is read from it."""
        path = self.path(begin, scene.places, mean)
        x = (self.register + mean + self.motion(path.hidden) + self.state_in(path.state))[:, None]
        for layer, block in enumerate(self.trajectory):
            x = block(x, scene.offered[:, :, layer], layer, memory)
        hidden = self.norm(x)[:, 0]
        logits = self._draw(scene, hidden if frames is None else take_rows(hidden, frames))
        with compute_in(torch.float32, x.device):
            hidden = hidden.float()
            nothing = hidden.new_zeros(*hidden.shape[:2], 0)
            return Prediction(logits, self.done(hidden).squeeze(-1), path.state, hidden, nothing), path

    def _draw(self, scene: Scene, hidden: Tensor) -> Tensor:
        """Frames of the scene as the trajectory's tokens (B, K, D) have them. → logits (B, K, S, V)"""
        count = hidden.shape[1]
        if not count:  # convolutions want something to work on
            sizes = scene.digits.shape[2], len(self.codebook.factor_of_logit)
            return hidden.new_zeros(len(hidden), 0, *sizes)
        given = ConditionTokens(hidden[:, :, None], None, hidden)
        x = scene.tokens.expand(-1, count, -1, -1)
        for block in self.renderer:
            x = block(x, given)
        local = scene.local[:, None].expand(-1, count, *(-1,) * 4).flatten(0, 2)
        return self.token_logits(self.drawn_norm(x), local, scene.digits.expand(-1, count, -1, -1))
