"""Fitting rewards to those that were recorded."""

from typing import Any

import torch
from lerobot.utils.constants import REWARD
from torch import Tensor


def recorded_rewards(batch: dict[str, Any]) -> Tensor:
    """`next.reward` of a batch, float32. ValueError if the dataset has none, or NaN or infinity in it."""
    reward = batch.get(REWARD)
    if not isinstance(reward, Tensor):  # LeRobot's processors put a number where the dataset has none
        raise ValueError(
            f"{REWARD}: the dataset has none, and a learned reward is fitted to it; record one with "
            "lerobot-wmrl-record, which writes the task's rule-based reward"
        )
    if not bool(torch.isfinite(reward).all()):
        raise ValueError(f"{REWARD}: holds NaN or infinity; remove the episodes that do from the dataset")
    return reward.float()


def regression(predicted: Tensor, reward: Tensor, known: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Mean squared error where `known`, and its root as a metric. All of one shape."""
    error = ((predicted - reward).square() * known).sum() / known.sum().clamp_min(1)
    return error, {"reward_error": error.sqrt().item()}
