"""Ways as points in space, or in joint space."""

import numpy as np


def resampled(path: np.ndarray, spacing: float) -> np.ndarray:
    """The polyline by evenly spread points at most `spacing` apart, both ends included. (N, D) → (M, D)"""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    even = np.linspace(0.0, along[-1], max(int(np.ceil(along[-1] / spacing)), 1) + 1)
    return np.stack([np.interp(even, along, coordinate) for coordinate in path.T], axis=1)
