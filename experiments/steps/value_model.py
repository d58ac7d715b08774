"""A value model of recorded episodes: from one frame, the probability that its episode succeeds.

The labels are the episodes' outcomes (Monte-Carlo returns), the loss is binary cross-entropy. Episodes are
dealt into folds, and each fold's values come from a model that was trained on the others (cross-fitting):
a model's values of its own training episodes would be memorised outcomes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from lerobot_policy_cnn.modeling_cnn import STATE_LIMIT
from lerobot_policy_cnn.networks import ObservationEncoder, Readout
from lerobot_policy_cnn.processor_cnn import MIN_DATASET_STD
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import random_shift
from lerobot_wmrl.data.checks import frame_size
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.data.lazy_rows import LazyRows

FOLDS: Final = 3
WIDTH: Final = 8
HIDDEN_SIZE: Final = 128
BATCH_SIZE: Final = 64
LEARNING_RATE: Final = 5e-4
WEIGHT_DECAY: Final = 1e-2
MAX_SHIFT: Final = 2
MAX_STEPS: Final = 1000

CHECK_EVERY: Final = 50
"""Steps between two measurements of the log-loss on the held-out fold."""

PATIENCE: Final = 5
"""Measurements without a lower log-loss after which training stops."""

MIN_PROBABILITY: Final = 1e-6


@dataclass(frozen=True)
class LabelledFrames:
    """What the value model sees of N frames, and the outcomes of their episodes.

    Args:
        images: (N, C, H, W, 3) uint8 of C cameras.
        state: (N, P), normalised.
        instructions: (N,).
        outcome: (N,), 1 where the frame's episode succeeds, else 0.
    """

    images: LazyRows
    state: Tensor
    instructions: np.ndarray
    outcome: Tensor

    @classmethod
    def read(cls, table: EpisodeTable) -> "LabelledFrames":
        """Read the frames of a dataset, decoding its videos once."""
        depth = set(table.dataset.meta.depth_keys)
        cameras = sorted(key for key in table.dataset.meta.camera_keys if key not in depth)
        if not cameras:
            raise FieldError("root", table.dataset.root, "has no camera", "use a dataset with images")
        std = np.maximum(table.state.std(0), MIN_DATASET_STD[OBS_STATE])
        side, _ = frame_size(table.dataset.features[cameras[0]])
        state = torch.from_numpy((table.state - table.state.mean(0)) / std)
        return cls(
            cached_frames(table.dataset, cameras, side),
            state.clamp(-STATE_LIMIT, STATE_LIMIT),
            np.repeat(np.array(table.instructions), table.length),
            torch.from_numpy(np.repeat(table.success, table.length)).float(),
        )


class ValueNetwork(nn.Module):
    """The encoder of the policy `cnn`, smaller, and a logit of success."""

    def __init__(self, cameras: int, state_size: int) -> None:
        super().__init__()
        self.encoder = ObservationEncoder(cameras, state_size, WIDTH)
        self.readout = Readout(self.encoder.size, HIDDEN_SIZE, outputs=1)

    def forward(self, images: Sequence[Tensor], state: Tensor, instructions: Sequence[str]) -> Tensor:
        """images: (B, 3, H, W) for each camera; state (B, P); B instructions → (B, 1)"""
        logit: Tensor = self.readout(self.encoder(images, state, instructions))
        return logit


def cross_fitted_values(table: EpisodeTable, seed: int) -> np.ndarray:
    """Return each frame's probability of success, by the model that has not seen its episode. (N,)"""
    frames = LabelledFrames.read(table)
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    fold = np.repeat(deal_folds(table.success, rng), table.length)
    values = np.empty(len(fold))
    for held_out in range(FOLDS):
        rows = np.flatnonzero(fold == held_out)
        values[rows] = fit_and_predict(frames, np.flatnonzero(fold != held_out), rows, rng)
    return values


def deal_folds(success: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Deal episodes at random into folds with equal shares of successes. (E,) → (E,)"""
    fold = np.empty(len(success), int)
    fold[np.lexsort((rng.random(len(success)), success))] = np.arange(len(success)) % FOLDS
    return fold


def fit_and_predict(
    frames: LabelledFrames, train: np.ndarray, held_out: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Fit a value model to the rows `train`, and predict the rows `held_out` where their log-loss is lowest.

    Returns:
        Probabilities of success, one for each held-out row.
    """
    network = ValueNetwork(frames.images.shape[1], frames.state.shape[1])
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    best, values, waited = np.inf, np.empty(len(held_out)), 0
    for step in range(1, MAX_STEPS + 1):
        rows = rng.choice(train, BATCH_SIZE)
        logits = value_logits(network, frames, rows, MAX_SHIFT)
        loss = F.binary_cross_entropy_with_logits(logits, frames.outcome[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % CHECK_EVERY == 0:
            predicted = predict(network, frames, held_out)
            found, waited = log_loss(predicted, frames.outcome[held_out].numpy()), waited + 1
            if found < best:
                best, values, waited = found, predicted, 0
            if waited == PATIENCE:
                break
    return values


@torch.no_grad()
def predict(network: ValueNetwork, frames: LabelledFrames, rows: np.ndarray) -> np.ndarray:
    """Return the probability of success at each of the rows."""
    batches = np.array_split(rows, range(BATCH_SIZE, len(rows), BATCH_SIZE))
    logits = [value_logits(network, frames, batch) for batch in batches]
    return torch.cat(logits).sigmoid().double().numpy()


def value_logits(
    network: ValueNetwork, frames: LabelledFrames, rows: np.ndarray, max_shift: int = 0
) -> Tensor:
    """Return logits of success (B,) at B rows, whose images are shifted at random by up to `max_shift`."""
    images = frames_to_tensor(frames.images[rows]).unbind(1)
    if max_shift:
        images = tuple(random_shift(image, max_shift) for image in images)
    return network(images, frames.state[rows], list(frames.instructions[rows])).squeeze(1)


def log_loss(values: np.ndarray, outcome: np.ndarray) -> float:
    """Return the mean negative log-likelihood of outcomes, 1 or 0, in nats a frame."""
    likelihood = np.where(outcome, values, 1 - values)
    return float(-np.log(likelihood.clip(MIN_PROBABILITY)).mean())
