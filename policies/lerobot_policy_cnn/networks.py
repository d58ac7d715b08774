"""Networks of the small image policy, in plain torch. B batch, C channels, H height, W width."""

import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_wmrl.common.images import coordinates, soft_positions
from lerobot_wmrl.common.instructions import distinct

GRID = 8
"""Cells on each side of the pooled feature map."""

GRID_CHANNELS = 16
"""Channels of the pooled feature map."""

LANGUAGE_BUCKETS = 256
"""Buckets that character trigrams and words are hashed into."""

LANGUAGE_SIZE = 32
"""Width of an instruction's embedding."""


def instance_norm(maps: Tensor) -> Tensor:
    """Normalise each channel of each image to mean 0 and variance 1 (Ulyanov et al. 2016). (B, C, H, W)

    A layer normalisation computes it, because torch's instance normalisation takes longer on CPUs than the
    convolutions when the memory format is channels_last.
    """
    return F.layer_norm(maps.contiguous(), maps.shape[2:])


class ImageEncoder(nn.Module):
    """Encode an image of any size as features that keep positions: a spatial softmax and a coarse map."""

    def __init__(self, width: int) -> None:
        super().__init__()
        wide = 2 * width
        self.stem = nn.Conv2d(3, width, 5, stride=2, padding=2)
        self.stem_position = nn.Conv2d(2, width, 5, stride=2, padding=2, bias=False)
        self.down = nn.Conv2d(width, wide, 3, stride=2, padding=1)
        self.fine = nn.Conv2d(wide, wide, 3, padding=1)
        self.coarse = nn.Conv2d(wide, wide, 3, stride=2, padding=1)
        self.grid = nn.Conv2d(wide, GRID_CHANNELS, 1)
        self.sharpness = nn.Parameter(torch.full((wide, 1, 1), 2.0))
        self.size = 2 * wide + GRID_CHANNELS * GRID * GRID
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        """Encode images in [0, 1]. (B, 3, H, W) → (B, self.size)"""
        position = torch.stack(coordinates(images.shape[2], images.shape[3], images))[None]
        centred = (4 * (images - 0.5)).contiguous(memory_format=torch.channels_last)
        x = F.relu_(self.stem(centred) + self.stem_position(position))
        x = F.relu_(self.down(x))
        fine = self.fine(x)
        coarse = self.grid(F.relu_(self.coarse(F.relu(fine))))
        positions = soft_positions(self.sharpness * instance_norm(fine))
        return torch.cat([positions, F.adaptive_avg_pool2d(coarse, GRID).flatten(1)], dim=1)


@lru_cache(maxsize=4096)
def ngram_counts(text: str) -> np.ndarray:
    """Return normalised counts of hashed words and character trigrams. No vocabulary is needed.

    → float32 (LANGUAGE_BUCKETS,)
    """
    counts = np.zeros(LANGUAGE_BUCKETS)
    words = text.lower().split()
    for word in words:
        padded = f"<{word}>"
        for gram in (padded, *(padded[i : i + 3] for i in range(len(padded) - 2))):
            counts[zlib.crc32(gram.encode()) % LANGUAGE_BUCKETS] += 1.0
    return (counts / max(1.0, float(np.sqrt(counts @ counts)))).astype(np.float32)


class InstructionEncoder(nn.Module):
    """Embed instructions by a linear layer on their n-gram counts."""

    def __init__(self) -> None:
        super().__init__()
        self.project = nn.Linear(LANGUAGE_BUCKETS, LANGUAGE_SIZE)

    def forward(self, instructions: Sequence[str]) -> Tensor:
        """Embed B strings, each distinct one once. → (B, LANGUAGE_SIZE)"""
        different, rows = distinct(instructions)
        counts = torch.from_numpy(np.stack([ngram_counts(text) for text in different]))
        return self.project(counts.to(self.project.weight.device)).tanh()[rows]


class ObservationEncoder(nn.Module):
    """Encode images, state and instruction as one vector of `size` features."""

    def __init__(self, cameras: int, state_size: int, width: int) -> None:
        super().__init__()
        self.encoders = nn.ModuleList(ImageEncoder(width) for _ in range(cameras))
        self.instruction = InstructionEncoder()
        images: int = sum(encoder.size for encoder in self.encoders)  # type: ignore[misc]
        self.size = images + state_size + LANGUAGE_SIZE

    def forward(self, images: Sequence[Tensor], state: Tensor | None, instructions: Sequence[str]) -> Tensor:
        """images: (B, 3, H, W) for each camera; state (B, P) or None; B instructions → (B, size)"""
        features = [encoder(image) for encoder, image in zip(self.encoders, images, strict=True)]
        return torch.cat(
            [*features, *([] if state is None else [state]), self.instruction(instructions)], dim=1
        )


class Readout(nn.Sequential):
    """Map features (B, size) to `outputs` values (B, outputs): the mean action, or the critic's value."""

    def __init__(self, size: int, hidden: int, outputs: int) -> None:
        head = nn.Linear(hidden, outputs)
        nn.init.orthogonal_(head.weight, 0.01)
        nn.init.zeros_(head.bias)
        super().__init__(
            nn.Linear(size, hidden),
            nn.LayerNorm(hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            head,
        )
