"""LPIPS itself, where its backbone is at hand; elsewhere its formula on tokenizer features stands in."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

BACKBONE = "alexnet-owt-7be5be79.pth"
"""torchvision's AlexNet, which the package `lpips` fetches and `TORCH_HOME` caches."""

PerceptualDistance = Callable[[Tensor, Tensor], Tensor]
"""Two (T, N, 3, H, W) in [0, 1] → (T,)."""


def cached_lpips(device: torch.device) -> PerceptualDistance | None:
    """LPIPS with AlexNet (Zhang et al. 2018), or None unless package and backbone are there: no download."""
    cached = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE
    if find_spec("lpips") is None or not cached.is_file():
        return None
    from lpips import LPIPS

    network = LPIPS(net="alex", verbose=False).to(device).eval()

    @torch.no_grad()
    def distance(images: Tensor, real: Tensor) -> Tensor:
        flat = network(images.flatten(0, 1), real.flatten(0, 1), normalize=True)
        return flat.reshape(images.shape[:2]).mean(1)

    return distance
