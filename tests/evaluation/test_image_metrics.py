"""Against numbers worked out by hand, or by another formula."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from lerobot_wmrl.evaluation.image_metrics import (
    depth_accuracy,
    masked_psnr,
    motion_mask,
    psnr,
    spatial_iou,
    spatiotemporal_iou,
    ssim,
    weighted_spatial_iou,
)


def pictures(*values: float) -> torch.Tensor:
    """Even grey frames (T, 2, 3, 16, 16)."""
    return torch.tensor(values)[:, None, None, None, None].expand(-1, 2, 3, 16, 16).clone()


def test_psnr_is_that_of_the_mean_squared_error():
    error = psnr(pictures(0.5, 0.5, 0.5), pictures(0.4, 0.49, 0.5))
    assert error.tolist() == pytest.approx([20, 40, 100], abs=1e-3)


def test_psnr_of_what_moved_leaves_the_background_out():
    real, imagined = pictures(0.5, 0.5), pictures(0.5, 0.5)
    real[0, 0, :, 2:4, 2:4] = 0.9
    imagined[0, 0, :, 2:4, 2:4] = 0.8
    moved = motion_mask(real, pictures(0.5))
    assert moved.sum((1, 2, 3)).tolist() == [4, 0]
    in_it, without_motion = masked_psnr(imagined, real, moved).tolist()
    assert in_it == pytest.approx(20, abs=1e-3)
    assert math.isnan(without_motion)
    assert psnr(imagined, real)[0] == pytest.approx(20 + 10 * math.log10(2 * 256 / 4), abs=1e-3)


def test_ssim_is_that_of_wang_et_al():
    """A second implementation, by scipy's Gaussian filter, of the published formula."""
    rng = np.random.default_rng(0)
    x = rng.random((24, 24))
    y = np.clip(x + 0.2 * rng.standard_normal((24, 24)), 0, 1)

    def blur(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, 1.5, radius=5)[5:-5, 5:-5]

    mx, my = blur(x), blur(y)
    covariance = blur(x * y) - mx * my
    expected = ((2 * mx * my + 1e-4) * (2 * covariance + 9e-4)) / (
        (mx**2 + my**2 + 1e-4) * (blur(x * x) - mx**2 + blur(y * y) - my**2 + 9e-4)
    )
    images, real = (torch.from_numpy(a).expand(1, 2, 3, 24, 24) for a in (x, y))
    assert ssim(images, real).item() == pytest.approx(expected.mean(), rel=1e-6)
    assert ssim(real, real).item() == pytest.approx(1)
    assert ssim(real[..., :10], real[..., :10]).isnan().tolist() == [True]


def test_overlap_of_motion_in_space_and_time():
    """Real motion in cells 0, then 0 and 1; imagined in 1, then 0 and 1: the same places, a frame late."""
    real = torch.tensor([[1, 0, 0], [1, 1, 0]], dtype=torch.bool)
    imagined = torch.tensor([[0, 1, 0], [1, 1, 0]], dtype=torch.bool)
    assert spatial_iou(real, imagined).item() == 1
    assert spatiotemporal_iou(real, imagined).item() == pytest.approx((0 + 1) / 2)
    assert weighted_spatial_iou(real, imagined).item() == pytest.approx((0.5 + 0.5) / (1 + 1))


def test_overlap_without_any_motion_is_no_number():
    nothing = torch.zeros(4, 9, dtype=torch.bool)
    for measure in (spatial_iou, spatiotemporal_iou, weighted_spatial_iou):
        assert math.isnan(measure(nothing, nothing).item())
    still = nothing.clone()
    still[0, 0] = True
    assert spatial_iou(nothing, still).item() == 0


def test_depth_counts_only_pixels_of_known_depth():
    real = torch.tensor([[1.0, 2.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    imagined = torch.tensor([[1.1, 1.0, 3.0, 1.5], [1.0, 1.0, 1.0, 1.0]])
    measured = depth_accuracy(imagined, real)
    assert measured["abs_rel"][0].item() == pytest.approx((0.1 + 0.5 + 0.5) / 3)
    assert measured["delta_1"][0].item() == pytest.approx(1 / 3)
    assert measured["delta_2"][0].item() == pytest.approx(2 / 3)
    assert all(math.isnan(values[1]) for values in measured.values())
