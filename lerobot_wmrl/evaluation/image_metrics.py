"""Distances between imagined and recorded frames: PSNR, SSIM, LPIPS, overlap of motion, and depth.

All of them are pure functions of images in [0, 1], N cameras a frame.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.world_models.frame_tokenizer import MOTION_THRESHOLD
from lerobot_wmrl.world_models.perceptual import backbone_path, lpips_network

MAX_PSNR = 100.0
"""dB of equal images."""

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""The constants of Wang et al. 2004 for values in [0, 1]."""

DEPTH_RATIO = 1.25
"""Base of the thresholds of δ₁, δ₂ (Eigen et al. 2014)."""

PerceptualDistance = Callable[[Tensor, Tensor], Tensor]
"""Two (T, N, 3, H, W) in [0, 1] → (T,)."""


def psnr_from_mse(mse: Tensor) -> Tensor:
    """Return −10 log₁₀ of the mean squared error of values in [0, 1], at most `MAX_PSNR`, in dB."""
    return -10 * mse.clamp_min(10 ** (-MAX_PSNR / 10)).log10()


def psnr(images: Tensor, target: Tensor) -> Tensor:
    """Return the PSNR of whole frames, all cameras together: (T, N, 3, H, W) in [0, 1] → dB (T,)."""
    return psnr_from_mse((images - target).square().flatten(1).mean(1))


def motion_mask(images: Tensor, first: Tensor) -> Tensor:
    """Return the pixels of which a colour differs from the first frame by more than `MOTION_THRESHOLD`.

    images (T, N, 3, H, W), first (N, 3, H, W) or (1, N, 3, H, W) → (T, N, H, W) bool.
    """
    return (images - first).abs().amax(-3) > MOTION_THRESHOLD


def masked_psnr(images: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Return the PSNR over the pixels in `mask`, NaN where it is empty: a static background flatters PSNR.

    images, target (T, N, 3, H, W), mask (T, N, H, W) → dB (T,).
    """
    error = ((images - target).square().mean(-3) * mask).flatten(1).sum(1)
    pixels = mask.flatten(1).sum(1)
    return torch.where(pixels > 0, psnr_from_mse(error / pixels.clamp_min(1)), torch.nan)


def ssim(images: Tensor, target: Tensor) -> Tensor:
    """Return the structural similarity (Wang et al. 2004, eq. 13), averaged over colours and cameras.

    It uses their Gaussian window of 11 pixels, without padding. (T, N, 3, H, W) in [0, 1] → (T,), NaN for
    images smaller than the window.
    """
    if min(images.shape[-2:]) < SSIM_WINDOW:
        return torch.full((len(images),), torch.nan, device=images.device)
    x, y = images.flatten(0, 2)[:, None], target.flatten(0, 2)[:, None]
    mean_x, mean_y = _blur(x), _blur(y)
    var_x, var_y = _blur(x * x) - mean_x**2, _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (var_x + var_y + SSIM_C2)
    return (luminance * structure).mean((1, 2, 3)).unflatten(0, (len(images), -1)).mean(1)


def _blur(images: Tensor) -> Tensor:
    """Gaussian means: (B, 1, H, W) → (B, 1, H − 10, W − 10)."""
    offset = torch.arange(SSIM_WINDOW, device=images.device) - SSIM_WINDOW // 2
    weight = torch.exp(-(offset**2) / (2 * SSIM_SIGMA**2)).to(images.dtype)
    weight = weight / weight.sum()
    return F.conv2d(F.conv2d(images, weight[None, None, :, None]), weight[None, None, None])


def cached_lpips(device: torch.device) -> PerceptualDistance | None:
    """Return LPIPS with AlexNet (Zhang et al. 2018), or None if its backbone is not in the cache.

    Nothing is downloaded.
    """
    return image_distance(lpips_network("alex", device)) if backbone_path("alex").is_file() else None


def image_distance(network: torch.nn.Module) -> PerceptualDistance:
    """Return a function that averages the distances of `network` over the cameras."""

    @torch.no_grad()
    def distance(images: Tensor, target: Tensor) -> Tensor:
        flat = network(images.flatten(0, 1), target.flatten(0, 1), normalize=True)
        return flat.reshape(images.shape[:2]).mean(1)

    return distance


def physics_iq(recorded: Tensor, imagined: Tensor) -> dict[str, float]:
    """Return the three motion overlaps of Physics-IQ (Motamed et al. 2025) for masks (T, N, H, W)."""
    return {
        "spatial_iou": float(spatial_iou(recorded, imagined)),
        "spatiotemporal_iou": float(spatiotemporal_iou(recorded, imagined)),
        "weighted_spatial_iou": float(weighted_spatial_iou(recorded, imagined)),
    }


def spatial_iou(recorded: Tensor, imagined: Tensor) -> Tensor:
    """Overlap of the pixels that moved at any time. Masks (T, …) bool → (), NaN if nothing moved."""
    union = recorded.any(0) | imagined.any(0)
    return _ratio((recorded.any(0) & imagined.any(0)).sum(), union.sum())


def spatiotemporal_iou(recorded: Tensor, imagined: Tensor) -> Tensor:
    """Overlap of the pixels that moved in each frame, averaged over the frames with any. → ()"""
    overlap = (recorded & imagined).flatten(1).sum(1)
    return _ratio(overlap, (recorded | imagined).flatten(1).sum(1)).nanmean()


def weighted_spatial_iou(recorded: Tensor, imagined: Tensor) -> Tensor:
    """Σ min / Σ max of the shares of time in which each pixel differs from the first frame. → ()"""
    share, imagined_share = recorded.float().mean(0), imagined.float().mean(0)
    return _ratio(torch.minimum(share, imagined_share).sum(), torch.maximum(share, imagined_share).sum())


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    return torch.where(whole > 0, part / whole, torch.nan)


def depth_accuracy(imagined: Tensor, recorded: Tensor) -> dict[str, Tensor]:
    """Return AbsRel, δ₁ and δ₂ (Eigen et al. 2014) of depth maps (T, N, H, W) in metres.

    Only pixels of known depth (> 0) count. Each (T,), NaN where no depth is known.
    """

    def mean(values: Tensor) -> Tensor:
        return torch.where(recorded > 0, values, torch.nan).flatten(1).nanmean(1)

    ratio = torch.maximum(imagined / recorded, recorded / imagined)
    within = {power: (ratio < DEPTH_RATIO**power) & (imagined > 0) for power in (1, 2)}
    return {
        "abs_rel": mean((imagined - recorded).abs() / recorded),
        "delta_1": mean(within[1].float()),
        "delta_2": mean(within[2].float()),
    }
