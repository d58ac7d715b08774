"""RoboScape's depth branch: it predicts the next depth, and guides the branch that predicts the tokens.

A transformer of its own, of the same layout, sees depth, the robot's state and the condition; layer by layer
its hidden states, projected, are added to those of the tokens (additive fusion). The projections begin at
zero, so the model begins as the one without depth. What the tokens' branch thinks never reaches this one.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Final

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import masked_mean
from lerobot_wmrl.data.clips import known_transitions
from lerobot_wmrl.world_models.frame_grids import FrameEmbedding, FrameHead
from lerobot_wmrl.world_models.st_transformer import LayerHook, SpatialTemporalTransformer, unchanged
from lerobot_wmrl.world_models.temporal_memory import TemporalMemory

FAR: Final = 2.5
"""Metres: what is further away counts as that far, as in the recorder's depth maps."""


def add_layer(added: Sequence[Tensor], layer: int, x: Tensor) -> Tensor:
    """x (B, T, S', D) and what is added to it after this layer."""
    return x + added[layer]


def given(depth: Tensor | None, shape: Sequence[int]) -> Tensor:
    """ValueError unless there is depth of this shape."""
    if depth is None or depth.shape != shape:
        found = "none" if depth is None else f"shape {tuple(depth.shape)}"
        raise ValueError(
            f"depth: {found}, but this world model has --model.depth=true and needs a number a token, shape "
            f"{tuple(shape)}; use a dataset recorded with --depth=true"
        )
    return depth


class NoDepth(nn.Module):
    """Base: a network that neither sees nor predicts depth. Its depth has no column, (…, 0)."""

    layers: int = 0
    """How many of the memory's layers the branch takes, behind those of the tokens' branch."""

    def normalize(self, depth: Tensor | None, tokens: Tensor) -> Tensor:
        """Depth of frames of these tokens (…, S): metres of each token → the network's units in [-1, 1]."""
        return torch.zeros(*tokens.shape[:-1], 0, device=tokens.device)

    def metres(self, depth: Tensor) -> Tensor:
        """The inverse of `normalize`."""
        return depth

    def forward(
        self, depth: Tensor | None, register: Tensor, condition: Tensor, mask: Tensor | None,
        memory: TemporalMemory,
    ) -> tuple[LayerHook, Tensor]:  # fmt: skip
        """What happens to the tokens' branch after each of its layers, and the next frames' depth (B, T, S).

        depth (B, T, S), register (B, T, 1, D), condition (B, T or 1, M, D); memory that of both branches.
        """
        return unchanged, register.new_zeros(*register.shape[:2], 0)

    def loss(self, predicted: Tensor, depth: Tensor, valid: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Mean absolute error of the predicted (B, T, S) against the next frames' depth, as far as those are
        valid (B, T)."""
        return predicted.new_zeros(()), {}


class DepthBranch(NoDepth):
    """Depth of N cameras, a number a token, to the next frame's."""

    def __init__(
        self, *, grid: int, num_cameras: int, patch: int, layers: int, width: int, heads: int, window: int,
        code_width: int, conditioning: str,
    ) -> None:  # fmt: skip
        super().__init__()
        self.grid, self.num_cameras, self.layers = grid, num_cameras, layers
        self.embedding = FrameEmbedding(1, grid, patch, code_width, width)
        self.camera = nn.Parameter(torch.randn(num_cameras, 1, width) * 0.02)
        self.transformer = SpatialTemporalTransformer(
            layers, width, heads, window, conditioning, first_layer=layers
        )
        self.fusion = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.head = FrameHead(0, 1, patch, code_width, width)  # one number a token, no gate
        for layer in (*self.fusion, self.head.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def normalize(self, depth: Tensor | None, tokens: Tensor) -> Tensor:
        return (given(depth, tokens.shape) / FAR).clamp(0, 1) * 2 - 1

    def metres(self, depth: Tensor) -> Tensor:
        return (depth + 1).clamp_min(0) / 2 * FAR

    def forward(
        self, depth: Tensor | None, register: Tensor, condition: Tensor, mask: Tensor | None,
        memory: TemporalMemory,
    ) -> tuple[LayerHook, Tensor]:  # fmt: skip
        grids = (self.num_cameras, self.grid, self.grid)
        frames, depth = register.shape[:2], given(depth, (*register.shape[:2], math.prod(grids)))
        tokens, local = self.embedding(depth.unflatten(2, grids).flatten(0, 2)[:, None])
        tokens = (tokens.unflatten(0, (*frames, self.num_cameras)) + self.camera).flatten(2, 3)
        added: list[Tensor] = []
        x = self.transformer(
            torch.cat([register, tokens], 2), condition, mask, memory, partial(self._project, added)
        )
        change, _ = self.head(x[:, :, 1:].unflatten(2, (self.num_cameras, -1)).flatten(0, 2), local)
        return partial(add_layer, added), depth + change.float().reshape(depth.shape)

    def _project(self, added: list[Tensor], layer: int, x: Tensor) -> Tensor:
        """Keep what this layer's hidden states add to the tokens' branch, and hand them on."""
        added.append(self.fusion[layer](x))
        return x

    def loss(self, predicted: Tensor, depth: Tensor, valid: Tensor) -> tuple[Tensor, dict[str, float]]:
        errors = (predicted[:, :-1].float() - depth[:, 1:]).abs()
        known = known_transitions(valid)[..., None]
        error = masked_mean(errors, known.expand_as(errors))
        return error, {"depth_error_mm": 1000 * FAR / 2 * error.item()}
