"""LPIPS itself, where its backbone is at hand; elsewhere its formula on tokenizer features stands in."""

from collections.abc import Callable

import torch
from torch import Tensor

from lerobot_wmrl.world_models.perceptual import backbone_path, lpips_network

PerceptualDistance = Callable[[Tensor, Tensor], Tensor]
"""Two (T, N, 3, H, W) in [0, 1] → (T,)."""


def cached_lpips(device: torch.device) -> PerceptualDistance | None:
    """LPIPS with AlexNet (Zhang et al. 2018), or None unless its backbone is there: no download."""
    return image_distance(lpips_network("alex", device)) if backbone_path("alex").is_file() else None


def image_distance(network: torch.nn.Module) -> PerceptualDistance:
    """The mean of `network`'s distances over cameras."""

    @torch.no_grad()
    def distance(images: Tensor, real: Tensor) -> Tensor:
        flat = network(images.flatten(0, 1), real.flatten(0, 1), normalize=True)
        return flat.reshape(images.shape[:2]).mean(1)

    return distance
