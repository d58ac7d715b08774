"""LPIPS (Zhang et al. 2018, eq. 1) by the package `lpips`.

The package ships its linear heads; their backbones are torchvision's, which are expected in torch's cache and
never downloaded here. Training takes VGG-16's, evaluation AlexNet's, as `lpips` advises.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Final

import torch
from lpips import LPIPS
from torch import Tensor
from torchvision.models import AlexNet_Weights, VGG16_Weights

from lerobot_wmrl.common.errors import FieldError

BACKBONES: Final = {"vgg": VGG16_Weights.IMAGENET1K_V1, "alex": AlexNet_Weights.IMAGENET1K_V1}
CONSTRUCTORS: Final = {"vgg": ("VGG-16", "vgg16"), "alex": ("AlexNet", "alexnet")}


@dataclass(frozen=True)
class PerceptualLoss:
    """`weight` times the distance that `network` sees between two batches of images in [−1, 1]."""

    network: Any
    weight: float

    def __call__(self, reconstruction: Tensor, images: Tensor) -> Tensor:
        """(F, 3, H, W), (F, 3, H, W) → ()"""
        return self.weight * self.network(reconstruction, images).mean()


def backbone_path(net: str) -> Path:
    """Return the backbone's file in `$TORCH_HOME/hub/checkpoints`, by default in `~/.cache/torch`."""
    return Path(torch.hub.get_dir()) / "checkpoints" / PurePosixPath(BACKBONES[net].url).name


def require_backbone(net: str, field: str, value: object, otherwise: str) -> None:
    """Raise FieldError unless torch's cache has the backbone that `field` asks for.

    The error says where the file belongs and how to get it there; `otherwise` is what to set the field to
    without it.
    """
    path, (name, constructor) = backbone_path(net), CONSTRUCTORS[net]
    if not path.is_file():
        raise FieldError(
            field,
            value,
            f"LPIPS needs the {name} of torchvision, and {path} is missing",
            f'where there is a network run python -c "import torchvision; torchvision.models.{constructor}('
            "weights='IMAGENET1K_V1')\" and copy the file there (TORCH_HOME says where the cache is), or set "
            f"`{field}` to {otherwise}",
        )


@cache
def lpips_network(net: str, device: torch.device) -> torch.nn.Module:
    """Return LPIPS on `vgg` or `alex`, frozen. Its backbone must be in torch's cache."""
    return LPIPS(net=net, verbose=False).requires_grad_(False).to(device)
