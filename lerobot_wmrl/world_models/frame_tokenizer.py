"""Frame tokenizer: RGB frames to a grid of discrete tokens and back (MAGVIT-2's role, FSQ codes).

A token is the index of one finite-scalar-quantised vector (Mentzer et al. 2023, eq. 1): no auxiliary
losses and no dead codes. Several cameras share the weights; their grids are concatenated.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from vector_quantize_pytorch import FSQ

PATCH = 4

MOTION_THRESHOLD = 0.08
"""A pixel has moved when a colour, in [0, 1], differs by more from the episode's first frame."""


class Decoded(NamedTuple):
    """Images (B, N, 3, H, W) in [0, 1] and the decoder's feature maps [(B·N, C, h, w), …]."""

    images: Tensor
    features: list[Tensor]


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a skip. (B, C, h, w) → (B, C, h, w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.conv_in = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv_out = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv_out(F.silu(self.conv_in(F.silu(self.norm(x)))))


class Encoder(nn.Module):
    """(B, 3, H, W) → (B, C, H/f, W/f), most of the work at the coarse grid."""

    def __init__(self, widths: Sequence[int], code_size: int) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3 * PATCH**2, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))
        self.block = ResidualBlock(widths[-1])
        self.head = nn.Conv2d(widths[-1], code_size, 1)

    def forward(self, images: Tensor) -> Tensor:
        x = self.stem(F.pixel_unshuffle(images, PATCH))
        for down in self.downs:
            x = down(F.silu(x))
        return self.head(F.silu(self.block(x)))


class Decoder(nn.Module):
    """(B, C, H/f, W/f) → (B, 3, H, W): the encoder's mirror image, with sub-pixel upsampling."""

    def __init__(self, widths: Sequence[int], code_size: int) -> None:
        super().__init__()
        coarse_to_fine = list(reversed(widths))
        self.stem = nn.Conv2d(code_size, coarse_to_fine[0], 3, padding=1)
        self.block = ResidualBlock(coarse_to_fine[0])
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 1) for a, b in itertools.pairwise(coarse_to_fine))
        self.smooth = nn.Conv2d(widths[0], widths[0], 3, padding=1)
        self.head = nn.Conv2d(widths[0], 3 * PATCH**2, 3, padding=1)

    def forward(self, codes: Tensor) -> tuple[Tensor, list[Tensor]]:
        x = self.block(self.stem(codes))
        features = [x]
        for up in self.ups:
            x = F.pixel_shuffle(up(F.silu(x)), 2)
        x = x + self.smooth(F.silu(x))
        features.append(x)
        return F.pixel_shuffle(self.head(F.silu(x)), PATCH), features


class FrameTokenizer(nn.Module):
    """Encode and decode are a pure pair: `decode(encode(images))` is the reconstruction.

    Args:
        image_size: side of the square frames, a multiple of `4 · 2^(len(widths) − 1)`.
        widths: channels from fine to coarse; each further entry halves the grid.
        levels: FSQ levels of each code factor; a token is one of their product.
        num_cameras: frames a time step, N.
    """

    def __init__(
        self, image_size: int, widths: Sequence[int], levels: Sequence[int], num_cameras: int = 1
    ) -> None:
        super().__init__()
        self.downsample = PATCH * 2 ** (len(widths) - 1)
        if image_size % self.downsample:
            raise ValueError(
                f"image_size={image_size} is not a multiple of the tokenizer's grid {self.downsample}"
            )
        self.image_size = image_size
        self.grid = image_size // self.downsample
        self.num_cameras = num_cameras
        self.encoder = Encoder(widths, len(levels))
        self.decoder = Decoder(widths, len(levels))
        self.quantizer = FSQ(list(levels))
        self.whiten = nn.ModuleList(
            nn.BatchNorm2d(channels, affine=False) for channels in (widths[-1], widths[0])
        )

    @property
    def tokens_per_frame(self) -> int:
        """S, over all cameras."""
        return self.num_cameras * self.grid**2

    def encode(self, images: Tensor) -> Tensor:
        """Images (B, N, 3, H, W) in [0, 1] → tokens (B, S) int64."""
        _, indices = self.quantizer(self.encoder(images.flatten(0, 1) * 2 - 1))
        return indices.reshape(images.shape[0], -1).long()

    def decode_with_features(self, tokens: Tensor) -> Decoded:
        """Tokens (B, S) → images and the whitened feature maps from which similarity is measured."""
        pixels, features = self.decoder(
            self.quantizer.indices_to_codes(tokens.reshape(-1, self.grid, self.grid))
        )
        images = ((pixels + 1) / 2).clamp(0, 1).unflatten(0, (len(tokens), self.num_cameras))
        return Decoded(images, self._whitened(features))

    def decode(self, tokens: Tensor) -> Tensor:
        """Tokens (B, S) → images (B, N, 3, H, W) in [0, 1]."""
        return self.decode_with_features(tokens).images

    def _whitened(self, features: list[Tensor]) -> list[Tensor]:
        """Zero mean and unit variance a channel over the training frames: without it what all frames share
        hides how they differ. The statistics are learnt in training and fixed afterwards."""
        return [whiten(feature) for whiten, feature in zip(self.whiten, features, strict=True)]

    def forward(self, images: Tensor, weight: Tensor | None = None) -> tuple[Tensor, dict[str, float]]:
        """Reconstruction loss: weighted L1 plus L2, images (B, N, 3, H, W), weight (B, N, 1, H, W)."""
        flat = images.flatten(0, 1) * 2 - 1
        codes, _ = self.quantizer(self.encoder(flat))
        pixels, features = self.decoder(codes)
        if self.training:
            self._whitened([feature.detach() for feature in features])
        error = pixels - flat
        weighted = error.abs() + error.square()
        if weight is not None:
            weighted = weighted * weight.flatten(0, 1)
        mse = error.detach().square().mean() / 4
        return weighted.mean(), {"psnr": float(-10 * torch.log10(mse))}


def motion_weight(images: Tensor, reference: Tensor, strength: float) -> Tensor:
    """1 on the static background, up to 1 + strength where a frame differs from its episode's start.

    A static background otherwise dominates the mean error and hides what decides success. All images
    (B, N, 3, H, W) in [0, 1] → (B, N, 1, H, W).
    """
    change = (images - reference).abs().amax(dim=2, keepdim=True)
    moved = F.max_pool2d((change.flatten(0, 1) > MOTION_THRESHOLD).float(), 5, stride=1, padding=2)
    return 1 + strength * moved.reshape(change.shape)


def feature_distance(features: Sequence[Tensor], goal: Sequence[Tensor]) -> Tensor:
    """LPIPS's formula (Zhang et al. 2018, eq. 1, unit weights) on tokenizer features: [(F, C, h, w)] → (F,).

    Each map is normalised over channels at every position; squared differences are summed over channels,
    averaged over positions and layers.
    """
    distances = [
        (F.normalize(a, dim=1) - F.normalize(b, dim=1)).square().sum(1).mean((1, 2))
        for a, b in zip(features, goal, strict=True)
    ]
    return torch.stack(distances).mean(0)
