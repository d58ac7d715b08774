"""Similarity of a frame to its goal frame (eq. 5), between 0 and 1.

The features of a goal frame are computed once, those of an imagined frame once a step. B environments have N
cameras each; features are a list of tensors (B·N, …), cameras as rows of the batch.
"""

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.rewards.configuration_rewards import LPIPS_BACKBONES
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, feature_distance
from lerobot_wmrl.world_models.goal import similarity_from_distance
from lerobot_wmrl.world_models.perceptual import lpips_network, require_backbone

Features = list[Tensor]


class Similarity(ABC):
    """1 − distance, averaged over an environment's cameras and clipped to [0, 1]."""

    @abstractmethod
    def features(self, frame: Decoded) -> Features:
        """Return the features by which frames are compared. → [(B·N, …)]"""

    @abstractmethod
    def distance(self, frame: Features, goal: Features) -> Tensor:
        """Return the distance of each camera's frame to its goal frame. → (B·N,)"""

    def __call__(self, frame: Features, goal: Features, cameras: int) -> Tensor:
        """Return the similarity of frames with `cameras` views each. → (B,)"""
        distance = self.distance(frame, goal)
        return similarity_from_distance(distance, len(distance) // cameras)


class TokenizerSimilarity(Similarity):
    """LPIPS's formula on the features of the tokenizer's decoder, which decoding computes anyway."""

    def features(self, frame: Decoded) -> Features:
        return frame.features

    def distance(self, frame: Features, goal: Features) -> Tensor:
        return feature_distance(frame, goal)


class PixelSimilarity(Similarity):
    """Mean squared error of pixel values in [0, 1]."""

    def features(self, frame: Decoded) -> Features:
        return [frame.images.flatten(0, 1)]

    def distance(self, frame: Features, goal: Features) -> Tensor:
        return (frame[0] - goal[0]).square().flatten(1).mean(1)


class PerceptualSimilarity(Similarity):
    """LPIPS (Zhang et al. 2018, eq. 1) with the backbone and linear heads of the package `lpips`."""

    def __init__(self, network: Any) -> None:
        self.network = network

    @torch.no_grad()
    def features(self, frame: Decoded) -> Features:
        images = self.network.scaling_layer(2 * frame.images.flatten(0, 1) - 1)
        return [F.normalize(layer, dim=1, eps=1e-10) for layer in self.network.net.forward(images)]

    @torch.no_grad()
    def distance(self, frame: Features, goal: Features) -> Tensor:
        layers = zip(self.network.lins, frame, goal, strict=True)
        return torch.stack([head((a - b).square()).mean((1, 2, 3)) for head, a, b in layers]).sum(0)


def make_similarity(kind: str, device: torch.device) -> Similarity:
    """Return the measure that `reward.similarity` names.

    Raises:
        ValueError: LPIPS's backbone is not cached. Nothing is downloaded, and no other measure takes its
            place.
    """
    if kind in LPIPS_BACKBONES:
        net = LPIPS_BACKBONES[kind]
        require_backbone(net, "reward.similarity", kind, "tokenizer or mse")
        return PerceptualSimilarity(lpips_network(net, device))
    return PixelSimilarity() if kind == "mse" else TokenizerSimilarity()
