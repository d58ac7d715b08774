"""Resize and normalise images for both vision transformers, bit for bit as Pillow and torchvision do.

B batch, C channels, H height, W width.
"""

from functools import cache

import torch
from torch import Tensor

MEAN = ((0.485, 0.456, 0.406), (0.5, 0.5, 0.5))
STD = ((0.229, 0.224, 0.225), (0.5, 0.5, 0.5))
"""Means and standard deviations for DINOv2 (ImageNet's) and for SigLIP."""

BICUBIC_A = -0.5
BICUBIC_SUPPORT = 2.0
PRECISION_BITS = 32 - 8 - 2
"""Pillow's filter for bytes works in integers: weights times 2^22, each pass rounded to a byte."""


def to_pixel_values(images: Tensor, size: int) -> Tensor:
    """Resize to `size` x `size` pixels regardless of the aspect ratio, and normalise twice (`resize-naive`).

    Args:
        images: (B, 3, H, W), uint8, or floating point in [0, 1], which is rounded to uint8.
        size: pixels of each side.

    Returns:
        float32 (B, 6, size, size): normalised for DINOv2, then for SigLIP.
    """
    check_images(images)
    pixels = images if images.dtype == torch.uint8 else (images * 255).round().clamp(0, 255).byte()
    resized = resize(pixels, size, size).float().div(255)
    mean, std = (torch.tensor(value, device=images.device).view(2, 1, 3, 1, 1) for value in (MEAN, STD))
    return ((resized - mean) / std).transpose(0, 1).flatten(1, 2)


def check_images(images: Tensor) -> None:
    """Raise ValueError unless `images` is a batch of RGB images."""
    known = images.dtype == torch.uint8 or images.is_floating_point()
    if images.ndim != 4 or images.shape[1] != 3 or not known:
        raise ValueError(
            f"images of shape {tuple(images.shape)} and type {images.dtype}: the policy needs (B, 3, H, W), "
            "torch.uint8 or floating point in [0, 1]"
        )


def resize(images: Tensor, height: int, width: int) -> Tensor:
    """Resize as Pillow's BICUBIC does, on CPU and CUDA. uint8 (B, C, H, W) → uint8 (B, C, height, width)"""
    images = _resize_last(images, width)
    return _resize_last(images.transpose(2, 3), height).transpose(2, 3)


def _resize_last(images: Tensor, size: int) -> Tensor:
    """Resize along the last dimension. Pillow leaves out a pass that would change nothing.

    Sums of integers below 2^53 are exact in float64.
    """
    if images.shape[-1] == size:
        return images
    weights = filter_matrix(images.shape[-1], size).to(images.device)
    total = images.double() @ weights.T + (1 << (PRECISION_BITS - 1))
    return (total / (1 << PRECISION_BITS)).floor().clamp(0, 255).byte()


@cache
def filter_matrix(before: int, after: int) -> Tensor:
    """Return the weight of each old pixel for each new one in units of 2^-22, float64 (after, before)."""
    scale = before / after
    stretch = max(scale, 1.0)
    support = BICUBIC_SUPPORT * stretch
    centres = (torch.arange(after, dtype=torch.float64)[:, None] + 0.5) * scale
    old = torch.arange(before)
    covered = (old >= (centres - support + 0.5).int()) & (old < (centres + support + 0.5).int())
    weights = bicubic((old - centres + 0.5) * (1.0 / stretch)) * covered
    fixed = weights / weights.sum(dim=1, keepdim=True) * (1 << PRECISION_BITS)
    return (fixed + torch.where(fixed < 0, -0.5, 0.5)).trunc()


def bicubic(x: Tensor) -> Tensor:
    """Evaluate Keys' cubic convolution kernel (1981) with a = −0.5 as Pillow does."""
    a, x = BICUBIC_A, x.abs()
    near = ((a + 2.0) * x - (a + 3.0)) * x * x + 1
    far = (((x - 5) * x + 8) * x - 4) * a
    return torch.where(x < 1.0, near, torch.where(x < BICUBIC_SUPPORT, far, 0.0))
