"""Frames of an episode beside each other, as a picture."""

import numpy as np
from PIL import Image

GAP = 2
"""White pixels between two frames."""


def in_a_row(frames: np.ndarray) -> np.ndarray:
    """Place frames side by side. (N, H, W, 3) uint8 → (H, N·W + gaps, 3)"""
    gap = np.full((frames.shape[1], GAP, 3), 255, np.uint8)
    return np.concatenate([part for frame in frames for part in (frame, gap)][:-1], 1)


def enlarged(picture: np.ndarray, factor: int) -> Image.Image:
    """Enlarge a picture (H, W, 3) uint8: every pixel becomes a square of `factor` pixels."""
    image = Image.fromarray(picture)
    return image.resize((factor * image.width, factor * image.height), Image.Resampling.NEAREST)
