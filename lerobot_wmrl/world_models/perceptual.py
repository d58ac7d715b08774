"""LPIPS (Zhang et al. 2018, eq. 1) as a training loss, by the package `lpips`, which is imported on use only.

The package ships its linear heads; their backbone is torchvision's VGG-16, which is expected in torch's cache
and never downloaded here.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class PerceptualLoss:
    """`weight` times the distance that `network` sees between two batches of images in [−1, 1]."""

    network: Any
    weight: float

    def __call__(self, reconstruction: Tensor, images: Tensor) -> Tensor:
        """(F, 3, H, W), (F, 3, H, W) → ()"""
        return self.weight * self.network(reconstruction, images).mean()


def backbone_path() -> Path:
    """Where torchvision keeps VGG-16: in `$TORCH_HOME/hub/checkpoints`, by default under `~/.cache/torch`."""
    from torchvision.models import VGG16_Weights

    return Path(torch.hub.get_dir()) / "checkpoints" / PurePosixPath(VGG16_Weights.IMAGENET1K_V1.url).name


def require_backbone() -> None:
    """ValueError says where the backbone's file belongs and how to get it there, unless it is there."""
    path = backbone_path()
    if not path.is_file():
        raise ValueError(
            f"--model.perceptual_weight: LPIPS needs the VGG-16 of torchvision, and {path} is missing. On a "
            'machine with network access run python -c "import torchvision; torchvision.models.vgg16('
            "weights='IMAGENET1K_V1')\" and copy the file there (TORCH_HOME says where the cache is), or "
            "train with --model.perceptual_weight=0"
        )


@cache
def lpips_network(device: torch.device) -> torch.nn.Module:
    """LPIPS on VGG-16, fixed: the form that trains best, where AlexNet's measures best (`lpips`'s advice)."""
    require_backbone()
    try:
        import lpips
    except ImportError as error:
        raise ValueError(
            "--model.perceptual_weight: the package lpips is not installed; pip install lpips, or train with "
            "--model.perceptual_weight=0"
        ) from error
    return lpips.LPIPS(net="vgg", verbose=False).requires_grad_(False).to(device)
