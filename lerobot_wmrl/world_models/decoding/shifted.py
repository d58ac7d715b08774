"""One-pass decoding: the tokens of a frame are drawn independently, given all frames before it."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lerobot_wmrl.world_models.frame_network import FrameNetwork, Prediction
from lerobot_wmrl.world_models.temporal_memory import ClipMemory, FrameCache

Condition = tuple[Tensor, Tensor | None]
"""Condition tokens (B, T or 1, M, D) and their mask (B, 1, 1, 1, M)."""


class FramesSeen(NamedTuple):
    """A pass of the network: the digits (B, T, S, C) it saw, under which condition, what it predicts of the
    next frames, and what drafts of these can attend to."""

    digits: Tensor
    condition: Condition
    prediction: Prediction
    memory: ClipMemory | FrameCache


class ShiftedDecoding(nn.Module):
    """The pass that sees a frame and writes the cache gives all logits of the next one: one pass a frame."""

    def __init__(self, config: Any, channels: int) -> None:
        """config: the world model's; channels: values that a token stands for, K."""
        super().__init__()

    def decode(
        self,
        network: FrameNetwork,
        seen: FramesSeen,
        temperature: float,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Draw the digits of the frames after those seen, at a temperature on the logits. → (B, T, S, C)"""
        return network.codebook.sample(seen.prediction.logits, temperature, generator)

    def loss(
        self, network: FrameNetwork, seen: FramesSeen, target: Tensor, weight: Tensor
    ) -> tuple[Tensor, dict[str, float]]:
        """What is learnt beyond the one-pass prediction: nothing.

        target (B, T − 1, S, C): the frames after all but the last seen; weight (B, T − 1, S) of their tokens.
        """
        return weight.new_zeros(()), {}
