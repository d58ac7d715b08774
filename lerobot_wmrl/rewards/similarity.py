"""How like its goal a frame looks (eq. 5), from 0 to 1: a frame is described once, and descriptions compared.

B environments with N cameras each; a description is a list of tensors, each (B·N, …).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.rewards.configuration_general import LPIPS_BACKBONES
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, feature_distance
from lerobot_wmrl.world_models.goal import alikeness
from lerobot_wmrl.world_models.perceptual import lpips_network, require_backbone

Description = list[Tensor]


class Similarity(ABC):
    """1 − distance, clipped to [0, 1] and averaged over an environment's cameras."""

    @abstractmethod
    def describe(self, frame: Decoded) -> Description:
        """What is compared of a frame; of a goal it is computed once."""

    @abstractmethod
    def distance(self, frame: Description, goal: Description) -> Tensor:
        """→ (B·N,)"""

    def __call__(self, frame: Description, goal: Description, cameras: int) -> Tensor:
        """→ (B,)"""
        distance = self.distance(frame, goal)
        return alikeness(distance, len(distance) // cameras)


class TokenizerSimilarity(Similarity):
    """By LPIPS's formula on the features of the tokenizer's decoder, which are there anyway."""

    def describe(self, frame: Decoded) -> Description:
        return list(frame.features)

    def distance(self, frame: Description, goal: Description) -> Tensor:
        return feature_distance(frame, goal)


class PixelSimilarity(Similarity):
    """By the mean squared error of values in [0, 1]."""

    def describe(self, frame: Decoded) -> Description:
        return [frame.images.flatten(0, 1)]

    def distance(self, frame: Description, goal: Description) -> Tensor:
        return (frame[0] - goal[0]).square().flatten(1).mean(1)


class PerceptualSimilarity(Similarity):
    """By LPIPS (Zhang et al. 2018, eq. 1), its backbone and linear heads those of the package `lpips`."""

    def __init__(self, network: Any) -> None:
        self.network = network

    @torch.no_grad()
    def describe(self, frame: Decoded) -> Description:
        images = self.network.scaling_layer(2 * frame.images.flatten(0, 1) - 1)
        return [F.normalize(layer, dim=1, eps=1e-10) for layer in self.network.net.forward(images)]

    @torch.no_grad()
    def distance(self, frame: Description, goal: Description) -> Tensor:
        layers = zip(self.network.lins, frame, goal, strict=True)
        return torch.stack([head((a - b).square()).mean((1, 2, 3)) for head, a, b in layers]).sum(0)


def make_similarity(kind: str, device: torch.device) -> Similarity:
    """By `--env.reward.similarity`. ValueError if the backbone of LPIPS is not cached: nothing is downloaded,
    and no other measure takes its place."""
    if kind in LPIPS_BACKBONES:
        net = LPIPS_BACKBONES[kind]
        require_backbone(net, f"--env.reward.similarity={kind}", "tokenizer or mse")
        return PerceptualSimilarity(lpips_network(net, device))
    return PixelSimilarity() if kind == "mse" else TokenizerSimilarity()


def of_rows(described: Sequence[Tensor], rows: Tensor, cameras: int) -> Description:
    """The descriptions of some of K frames: rows (B,) of [(K·N, …)] → [(B·N, …)]"""
    each = (rows[:, None] * cameras + torch.arange(cameras, device=rows.device)).flatten()
    return [part[each] for part in described]
