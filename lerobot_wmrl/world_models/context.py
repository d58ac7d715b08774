"""What a context-conditioned tokenizer knows of an episode beforehand: features of its first frame.

Tokens then need not carry the static detail of a scene, only what moves in it (iVideoGPT, Wu et al. 2024, and
Delta-IRIS, Micheli et al. 2024, do so with their own contexts).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class Context:
    """Features of B first frames, a map (B, N, C, h, w) a scale, coarse to fine; without the option none."""

    scales: tuple[Tensor, ...] = ()

    def __getitem__(self, rows: Any) -> "Context":
        """The context of some of the B frames: an index, mask or slice of the first dimension."""
        return Context(tuple(scale[rows] for scale in self.scales))

    def __len__(self) -> int:
        return len(self.scales[0]) if self.scales else 0

    def replaced(self, mask: Tensor, new: "Context") -> "Context":
        """The rows of `new` where `mask` (B,) is True, else one's own."""
        return Context(
            tuple(
                torch.where(mask[:, None, None, None, None], b, a)
                for a, b in zip(self.scales, new.scales, strict=True)
            )
        )

    def flat(self) -> list[Tensor]:
        """[(B·N, C, h, w), …], cameras as rows of the batch."""
        return [scale.flatten(0, 1) for scale in self.scales]


NO_CONTEXT: Final = Context()


class ContextEncoder(nn.Module):
    """First frames to features at every scale of the decoder."""

    def __init__(self, widths: Sequence[int], patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.stem = nn.Conv2d(3 * patch**2, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))

    def forward(self, images: Tensor) -> Context:
        """Images (B, N, 3, H, W) in [0, 1] → their context."""
        scales = [self.stem(F.pixel_unshuffle(images.flatten(0, 1) * 2 - 1, self.patch))]
        for down in self.downs:
            scales.append(down(F.silu(scales[-1])))
        return Context(tuple(scale.unflatten(0, images.shape[:2]) for scale in reversed(scales)))


class Fusion(nn.Module):
    """Adds to features (F, C, h, w) what a 1x1 convolution makes of them and the context's (F, C, h, w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mix = nn.Conv2d(2 * channels, channels, 1)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        return x + self.mix(F.silu(torch.cat([x, context], 1)))
