"""Functions of images that policies and world models share. B batch, C channels, H height, W width."""

from typing import Final

import cv2
import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor
from torch.nn import functional as F
from torchvision.transforms.v2 import functional as transforms

JPEG_QUALITY: Final = 92


def camera_key(camera: str) -> str:
    """Return a camera's key in a dataset: `observation.images.` and its name, or a name that is a key."""
    return camera if camera.startswith("observation.") else f"{OBS_IMAGES}.{camera}"


def to_bytes(images: Tensor) -> Tensor:
    """Convert images from [0, 1] to uint8."""
    return (images * 255).round().byte()


def from_bytes(images: Tensor) -> Tensor:
    """Convert images from uint8 to [0, 1]."""
    return images.float() / 255


def to_pixels(images: Tensor) -> np.ndarray:
    """Return images in [0, 1], or uint8 already, as numpy's libraries want them. (…, C, H, W) → uint8
    (…, H, W, C)"""
    return (images if images.dtype == torch.uint8 else to_bytes(images)).movedim(-3, -1).cpu().numpy()


def jpeg(image: np.ndarray) -> bytes:
    """Encode an image (H, W, 3) uint8."""
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def stretch(images: Tensor, height: int, width: int) -> Tensor:
    """Stretch images to a size, each axis by itself: (…, C, h, w) → (…, C, height, width).

    Bilinear; where an axis shrinks, over all the pixels that become one (antialiasing).
    """
    if images.shape[-2:] == (height, width):
        return images
    return transforms.resize(images, [height, width], antialias=True)


def coordinates(height: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return row and column positions in [-1, 1]. → (H, W), (H, W)"""
    rows = torch.linspace(-1, 1, height, device=like.device, dtype=like.dtype)
    columns = torch.linspace(-1, 1, width, device=like.device, dtype=like.dtype)
    return torch.meshgrid(rows, columns, indexing="ij")  # type: ignore[return-value]


def soft_positions(maps: Tensor) -> Tensor:
    """Return each channel's expected position (B, 2C) (spatial softmax, Levine et al. 2016). (B, C, H, W)"""
    rows, columns = coordinates(maps.shape[2], maps.shape[3], maps)
    attention = maps.flatten(2).softmax(dim=-1)
    return torch.cat([attention @ rows.flatten(), attention @ columns.flatten()], dim=1)


def random_shift(images: Tensor, pixels: int) -> Tensor:
    """Shift each image by up to `pixels` along both axes, repeating its edges. (B, C, H, W) → same"""
    batch, _, height, width = images.shape
    padded = F.pad(images, (pixels,) * 4, mode="replicate")
    top, left = (torch.randint(0, 2 * pixels + 1, (batch, 1), device=images.device) for _ in range(2))
    rows = (top + torch.arange(height, device=images.device))[:, None, :, None]
    columns = (left + torch.arange(width, device=images.device))[:, None, None, :]
    batch_index = torch.arange(batch, device=images.device)[:, None, None, None]
    channel_index = torch.arange(images.shape[1], device=images.device)[None, :, None, None]
    return padded[batch_index, channel_index, rows, columns]
