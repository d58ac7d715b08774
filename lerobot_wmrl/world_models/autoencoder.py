"""Convolutional encoder and decoder of the frame tokenizer; most of their work is at the coarsest scale.

As an option encoder and decoder are given features of the episode's first frame. Tokens then need not carry
the static detail of a scene, only what moves in it (iVideoGPT, Wu et al. 2024, and Delta-IRIS, Micheli et al.
2024, do so with contexts of their own).
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import cast

from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.world_models.configuration_frame_tokenizer import NORM_GROUPS, PATCH


class ContextEncoder(nn.Module):
    """First frames (F, 3, H, W) in [−1, 1] → features [(F, C, h, w), …] from coarse to fine."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3 * PATCH**2, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))

    def forward(self, images: Tensor) -> list[Tensor]:
        scales = [self.stem(F.pixel_unshuffle(images, PATCH))]
        for down in self.downs:
            scales.append(down(F.silu(scales[-1])))
        return scales[::-1]


class Fusion(nn.Module):
    """Add to features a 1x1 convolution over them and the context's features side by side, all (F, C, h, w).

    That convolution is the sum of one over each of them, and the context's is computed once an episode.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mix = nn.Conv2d(2 * channels, channels, 1)

    def project(self, context: Tensor) -> Tensor:
        """Convolve the context's features, (F, C, h, w) → (F, C, h, w)."""
        return F.conv2d(F.silu(context), self.mix.weight[:, context.shape[1] :], self.mix.bias)

    def forward(self, x: Tensor, projected: Tensor) -> Tensor:
        """Fuse features with a context that `project` has convolved."""
        mixed = F.conv2d(F.silu(x), self.mix.weight[:, : x.shape[1]])
        return x + mixed + projected.to(mixed.dtype)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a skip. (B, C, h, w) → (B, C, h, w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(NORM_GROUPS, channels)
        self.conv_in = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv_out = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv_out(F.silu(self.conv_in(F.silu(self.norm(x)))))


class Encoder(nn.Module):
    """Images (F, 3, H, W) → vectors (F, K, g, g).

    With a context it also takes the context's projections, [(F, c, g, g)].
    """

    def __init__(self, widths: Sequence[int], channels: int, context: bool) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3 * PATCH**2, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))
        self.block = ResidualBlock(widths[-1])
        self.head = nn.Conv2d(widths[-1], channels, 1, bias=False)  # normalised next
        self.fusion = Fusion(widths[-1]) if context else None

    def project(self, scales: Sequence[Tensor]) -> list[Tensor]:
        """Project a context's features, [(F, c, h, w), …] from coarse to fine, for the fusion."""
        return [] if self.fusion is None else [self.fusion.project(scales[0])]

    def forward(self, images: Tensor, projections: Sequence[Tensor]) -> Tensor:
        x = self.stem(F.pixel_unshuffle(images, PATCH))
        for down in self.downs:
            x = down(F.silu(x))
        if self.fusion is not None:
            x = self.fusion(x, projections[0])
        return self.head(F.silu(self.block(x)))


class Decoder(nn.Module):
    """Values (F, K, g, g) → images (F, 3, H, W): the encoder's mirror image, with sub-pixel upsampling.

    With a context it also takes the context's projections [(F, c, h, w), …], one a scale from coarse to fine.
    """

    def __init__(self, widths: Sequence[int], channels: int, context: bool) -> None:
        super().__init__()
        coarse_to_fine = list(reversed(widths))
        self.stem = nn.Conv2d(channels, coarse_to_fine[0], 3, padding=1)
        self.block = ResidualBlock(coarse_to_fine[0])
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 1) for a, b in itertools.pairwise(coarse_to_fine))
        self.smooth = nn.Conv2d(widths[0], widths[0], 3, padding=1)
        self.head = nn.Conv2d(widths[0], 3 * PATCH**2, 3, padding=1)
        self.fusions = nn.ModuleList(Fusion(width) for width in coarse_to_fine if context)

    def project(self, scales: Sequence[Tensor]) -> list[Tensor]:
        """Project a context's features, [(F, c, h, w), …] from coarse to fine, for the fusions."""
        fusions = cast(Iterable[Fusion], self.fusions)
        return [fusion.project(scale) for fusion, scale in zip(fusions, scales, strict=True)]

    def forward(self, values: Tensor, projections: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        x = self.block(self._fuse(self.stem(values), projections, 0))
        features = [x]
        for scale, up in enumerate(self.ups, 1):
            x = self._fuse(F.pixel_shuffle(up(F.silu(x)), 2), projections, scale)
        x = x + self.smooth(F.silu(x))
        features.append(x)
        return F.pixel_shuffle(self.head(F.silu(x)), PATCH), features

    def _fuse(self, x: Tensor, projections: Sequence[Tensor], scale: int) -> Tensor:
        return self.fusions[scale](x, projections[scale]) if self.fusions else x
