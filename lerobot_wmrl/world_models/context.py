"""What a context-conditioned tokenizer knows of an episode beforehand: features of its first frame.

Tokens then need not carry the static detail of a scene, only what moves in it (iVideoGPT, Wu et al. 2024, and
Delta-IRIS, Micheli et al. 2024, do so with their own contexts).
"""

import itertools
from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F


class ContextEncoder(nn.Module):
    """First frames (F, 3, H, W) in [−1, 1] to features [(F, C, h, w), …], coarse to fine."""

    def __init__(self, widths: Sequence[int], patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.stem = nn.Conv2d(3 * patch**2, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))

    def forward(self, images: Tensor) -> list[Tensor]:
        scales = [self.stem(F.pixel_unshuffle(images, self.patch))]
        for down in self.downs:
            scales.append(down(F.silu(scales[-1])))
        return scales[::-1]


class Fusion(nn.Module):
    """Adds to features what a 1x1 convolution makes of them and the context's, all (F, C, h, w).

    The convolution of both side by side is the sum of one of each: the context's is computed once an episode.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mix = nn.Conv2d(2 * channels, channels, 1)

    def offer(self, context: Tensor) -> Tensor:
        """What is added on behalf of the context."""
        return F.conv2d(F.silu(context), self.mix.weight[:, context.shape[1] :], self.mix.bias)

    def forward(self, x: Tensor, offered: Tensor) -> Tensor:
        """`offered` is what `offer` returned."""
        mixed = F.conv2d(F.silu(x), self.mix.weight[:, : x.shape[1]])
        return x + mixed + offered.to(mixed.dtype)
