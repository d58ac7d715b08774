"""Convolutional encoder and decoder of the frame tokenizer, most of their work at the coarse grid."""

import itertools
from collections.abc import Iterable, Sequence
from typing import cast

from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.world_models.configuration_frame_tokenizer import NORM_GROUPS, PATCH
from lerobot_wmrl.world_models.context import Fusion


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
    """(F, 3, H, W) → (F, C, H/f, W/f); with a context it is given what its fusion offers, [(F, c, h, w)]."""

    def __init__(self, widths: Sequence[int], code_size: int, context: bool) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3 * PATCH**2, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))
        self.block = ResidualBlock(widths[-1])
        self.head = nn.Conv2d(widths[-1], code_size, 1)
        self.fusion = Fusion(widths[-1]) if context else None

    def offers(self, scales: Sequence[Tensor]) -> list[Tensor]:
        """What the fusion makes of a context's features, [(F, c, h, w), …] from coarse to fine."""
        return [] if self.fusion is None else [self.fusion.offer(scales[0])]

    def forward(self, images: Tensor, offers: Sequence[Tensor]) -> Tensor:
        x = self.stem(F.pixel_unshuffle(images, PATCH))
        for down in self.downs:
            x = down(F.silu(x))
        if self.fusion is not None:
            x = self.fusion(x, offers[0])
        return self.head(F.silu(self.block(x)))


class Decoder(nn.Module):
    """(F, C, H/f, W/f) → (F, 3, H, W): the encoder's mirror image, with sub-pixel upsampling.

    With a context it is given what its fusions offer, one a scale, [(F, c, h, w), …] from coarse to fine.
    """

    def __init__(self, widths: Sequence[int], code_size: int, context: bool) -> None:
        super().__init__()
        coarse_to_fine = list(reversed(widths))
        self.stem = nn.Conv2d(code_size, coarse_to_fine[0], 3, padding=1)
        self.block = ResidualBlock(coarse_to_fine[0])
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 1) for a, b in itertools.pairwise(coarse_to_fine))
        self.smooth = nn.Conv2d(widths[0], widths[0], 3, padding=1)
        self.head = nn.Conv2d(widths[0], 3 * PATCH**2, 3, padding=1)
        self.fusions = nn.ModuleList(Fusion(channels) for channels in coarse_to_fine if context)

    def offers(self, scales: Sequence[Tensor]) -> list[Tensor]:
        """What the fusions make of a context's features, [(F, c, h, w), …] from coarse to fine."""
        fusions = cast(Iterable[Fusion], self.fusions)
        return [fusion.offer(scale) for fusion, scale in zip(fusions, scales, strict=True)]

    def forward(self, codes: Tensor, offers: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        x = self.block(self._fuse(self.stem(codes), offers, 0))
        features = [x]
        for scale, up in enumerate(self.ups, 1):
            x = self._fuse(F.pixel_shuffle(up(F.silu(x)), 2), offers, scale)
        x = x + self.smooth(F.silu(x))
        features.append(x)
        return F.pixel_shuffle(self.head(F.silu(x)), PATCH), features

    def _fuse(self, x: Tensor, offers: Sequence[Tensor], scale: int) -> Tensor:
        return self.fusions[scale](x, offers[scale]) if self.fusions else x
