"""RoboScape's depth branch: it predicts the next depth, and guides the branch that predicts the tokens.

A transformer of its own, of the same layout, sees depth, the robot's state and the condition; layer by layer
its hidden states, projected, are added to those of the tokens (additive fusion). The projections begin at
zero, so the model begins as the one without depth. Nothing flows from the tokens' branch to this one.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lerobot_wmrl.data.clips import known_transitions
from lerobot_wmrl.data.frame_cache import FAR
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.network import SpatialTemporalTransformer
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.layers import FrameEmbedding, FrameHead, FrameSizes, TemporalMemory
from lerobot_wmrl.world_models.losses import masked_mean


def normalize_depth(depth: Tensor | None, tokens: Tensor) -> Tensor:
    """Metres (…, S) of each of the tokens (…, S) → [−1, 1]."""
    return (require_depth(depth, tokens.shape) / FAR).clamp(0, 1) * 2 - 1


def metres(depth: Tensor) -> Tensor:
    """Return the inverse of `normalize_depth`."""
    return (depth + 1).clamp_min(0) / 2 * FAR


def require_depth(depth: Tensor | None, shape: Sequence[int]) -> Tensor:
    """Return the depth. ValueError unless it has this shape."""
    if depth is None or depth.shape != shape:
        actual = "none" if depth is None else f"shape {tuple(depth.shape)}"
        raise ValueError(
            f"depth: {actual}, but this world model looks at depth (`dynamics.depth`) and needs a number a "
            f"token, shape {tuple(shape)}; use a dataset recorded with depth"
        )
    return depth


class DepthBranch(nn.Module):
    """Predicts the depth of N cameras, a number a token, from the frame before."""

    def __init__(self, config: AutoregressiveConfig, sizes: FrameSizes) -> None:
        super().__init__()
        width, layers = config.width, config.layers
        self.grid, self.num_cameras = sizes.grid, sizes.num_cameras
        self.embedding = FrameEmbedding(1, sizes.grid, config.patch, config.code_width, width)
        self.camera = nn.Parameter(torch.randn(sizes.num_cameras, 1, width) * 0.02)
        self.transformer = SpatialTemporalTransformer(
            layers, width, config.heads, config.conditioning, first_layer=layers
        )
        self.fusion = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.head = FrameHead(0, 1, config.patch, config.code_width, width)  # one number a token, no gate
        for layer in (*self.fusion, self.head.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self, depth: Tensor | None, register: Tensor, condition: Condition, memory: TemporalMemory
    ) -> tuple[list[Tensor], Tensor]:
        """Predict the next frames' depth.

        Args:
            depth: (B, T, S), normalised.
            register: the frames' register tokens (B, T, 1, D).
            condition: tokens (B, T or 1, M, D).
            memory: shared with the tokens' branch.

        Returns:
            What it adds to the tokens after each layer, (B, T, 1 + S', D) each, and the depth (B, T, S).
        """
        grids = (self.num_cameras, self.grid, self.grid)
        frames = register.shape[:2]
        depth = require_depth(depth, (*frames, self.num_cameras * self.grid**2))
        tokens, local = self.embedding(depth.unflatten(2, grids).flatten(0, 2)[:, None])
        tokens = (tokens.unflatten(0, (*frames, self.num_cameras)) + self.camera).flatten(2, 3)
        x, added = self.transformer(torch.cat([register, tokens], 2), condition, memory, fusion=self.fusion)
        change, _ = self.head(x[:, :, 1:].unflatten(2, (self.num_cameras, -1)).flatten(0, 2), local)
        return added, depth + change.float().reshape(depth.shape)


def depth_loss(predicted: Tensor, depth: Tensor, valid: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Mean absolute error of predicted (B, T, S) against the next frames' depth where valid (B, T).

    Tokens without a measurement, of 0 m, are left out.
    """
    errors = (predicted[:, :-1].float() - depth[:, 1:]).abs()
    known = known_transitions(valid)[..., None] & (depth[:, 1:] > -1)
    error = masked_mean(errors, known)
    return error, {"depth_error_mm": 1000 * FAR / 2 * error.item()}
