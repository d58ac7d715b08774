"""Between grids of numbers, one cell a token of the tokenizer, and the transformer's tokens."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F


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


class ContextEmbedding(nn.Module):
    """What a context-conditioned tokenizer sees in an episode's first frame, to the transformer's tokens.

    Its features are continuous: they say where things lie twice as exactly as the first frame's codes.
    """

    def __init__(self, channels: int, patch: int, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(1, channels)
        self.patches = nn.Conv2d(channels, width, patch, stride=patch)

    def forward(self, features: Tensor) -> Tensor:
        """Coarsest features (B, N, C, g, g) of N cameras → tokens (B, N·(g/patch)², D)."""
        tokens = self.patches(self.norm(features.flatten(0, 1))).flatten(2).transpose(1, 2)
        return tokens.unflatten(0, features.shape[:2]).flatten(1, 2)


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
