"""How close pictures are: PSNR, of the moving region too, and SSIM."""

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.world_models.frame_tokenizer import MOTION_THRESHOLD

LARGEST_PSNR = 100.0
"""dB of equal pictures."""

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""The constants of Wang et al. 2004 for values in [0, 1]."""


def psnr_from_mse(mse: Tensor) -> Tensor:
    """−10 log₁₀ of the mean squared error of values in [0, 1], at most `LARGEST_PSNR`. dB."""
    return -10 * mse.clamp_min(10 ** (-LARGEST_PSNR / 10)).log10()


def psnr(images: Tensor, real: Tensor) -> Tensor:
    """Of whole frames, all cameras together: (T, N, 3, H, W) in [0, 1] → dB (T,)."""
    return psnr_from_mse((images - real).square().flatten(1).mean(1))


def motion_mask(images: Tensor, first: Tensor) -> Tensor:
    """Pixels of which a colour differs from the first frame by more than `MOTION_THRESHOLD`.

    images (T, N, 3, H, W), first (N, 3, H, W) or (1, N, 3, H, W) → (T, N, H, W) bool.
    """
    return (images - first).abs().amax(-3) > MOTION_THRESHOLD


def masked_psnr(images: Tensor, real: Tensor, mask: Tensor) -> Tensor:
    """PSNR of the pixels in `mask` (T, N, H, W): a static background flatters. NaN where the mask is empty.

    images, real (T, N, 3, H, W) → dB (T,).
    """
    error = ((images - real).square().mean(-3) * mask).flatten(1).sum(1)
    pixels = mask.flatten(1).sum(1)
    return torch.where(pixels > 0, psnr_from_mse(error / pixels.clamp_min(1)), torch.nan)


def ssim(images: Tensor, real: Tensor) -> Tensor:
    """Structural similarity, eq. 13 of Wang et al. 2004, with their Gaussian window of 11 pixels and without
    padding; averaged over colours and cameras. (T, N, 3, H, W) in [0, 1], H, W ≥ 11 → (T,)"""
    x, y = images.flatten(0, 2)[:, None], real.flatten(0, 2)[:, None]
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
