"""A success probe: a small CNN that says whether success holds in a frame that a world model decodes.

It learns from recorded frames, labelled by the dataset's own `next.success`. It sees every frame as the
tokenizer decodes it, because goal frames exist only decoded, and beside its episode's first frame, because
success can depend on where things were.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import trange

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.reconstruction import reconstructions
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer

PROBE_VALIDATION_EVERY = 5
"""Every fifth episode is held out from the probe's training, those that world models hold out among them."""

MAX_PROBE_FRAMES = 1500
"""Frames of each class in the probe's training, and of each in its validation."""

PROBE_SIZE = 64
PROBE_EPOCHS = 10
PROBE_BATCH = 64
PROBE_LEARNING_RATE = 1e-3


class SuccessProbe(nn.Module):
    """First frame and frame (B, N, 3, H, W) in [0, 1], both decoded → the logit of success (B,)."""

    def __init__(self, num_cameras: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(6 * num_cameras, 32, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(32, 48, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(48, 64, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Dropout(0.2),
            nn.Linear(64 * (PROBE_SIZE // 8) ** 2, 64),
            nn.ReLU(),
            nn.Linear(64, 1),
        )

    def forward(self, first: Tensor, images: Tensor) -> Tensor:
        return self.layers(torch.cat([_small(first), _small(images)], 1) - 0.5)[:, 0]


@dataclass(frozen=True)
class TrainedProbe:
    """A probe and its balanced accuracy on episodes it has not seen, NaN without any."""

    network: SuccessProbe
    balanced_accuracy: float
    frames: int
    held_out_frames: int

    @torch.no_grad()
    def success(self, first: Tensor, images: Tensor) -> Proportion:
        """Return the share of decoded frames (F, N, 3, H, W) in which success holds."""
        return Proportion.of((self.network(first, images) > 0).cpu().numpy())

    def as_json(self) -> dict[str, Any]:
        known = np.isfinite(self.balanced_accuracy)
        return {
            "balanced_accuracy": self.balanced_accuracy if known else None,
            "frames": self.frames,
            "held_out_frames": self.held_out_frames,
        }


@dataclass(frozen=True)
class LabelledFrames:
    """first, images (F, N, 3, H, W), decoded; success (F,) bool."""

    first: Tensor
    images: Tensor
    success: Tensor


def train_probe(tokenizer: FrameTokenizer, recording: Recording) -> TrainedProbe | None:
    """Train on as many frames with success as without, of the recording's chosen episodes, with a fixed seed.
    None if a class is empty."""
    held_out = held_out_from_probe(np.arange(len(recording.table.start)))
    rng = np.random.default_rng(0)
    training, test = (
        labelled_frames(tokenizer, recording, part & recording.readable, rng)
        for part in (~held_out, held_out)
    )
    if training is None:
        return None
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = fit(SuccessProbe(tokenizer.num_cameras).to(training.images.device), training, rng)
    accuracy = balanced_accuracy(network, test) if test is not None else np.nan
    return TrainedProbe(network, accuracy, len(training.success), 0 if test is None else len(test.success))


def held_out_from_probe(episodes: np.ndarray) -> np.ndarray:
    """Whether the probe does not train on each episode. (E,) → (E,) bool"""
    return episodes % PROBE_VALIDATION_EVERY == PROBE_VALIDATION_EVERY - 1


def fit(network: SuccessProbe, data: LabelledFrames, rng: np.random.Generator) -> SuccessProbe:
    """Minimise the binary cross-entropy over `PROBE_EPOCHS` passes."""
    optimizer = torch.optim.AdamW(network.parameters(), PROBE_LEARNING_RATE, weight_decay=0.01)
    for _ in trange(PROBE_EPOCHS, desc="Training the success probe", unit="epoch"):
        for index in torch.from_numpy(rng.permutation(len(data.success))).split(PROBE_BATCH):
            logit = network(data.first[index], data.images[index])
            loss = F.binary_cross_entropy_with_logits(logit, data.success[index].float())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return network.eval()


@torch.no_grad()
def balanced_accuracy(network: SuccessProbe, data: LabelledFrames) -> float:
    """Return the mean of the accuracies on frames with and without success."""
    right = (network(data.first, data.images) > 0) == data.success
    return float((right[data.success].float().mean() + right[~data.success].float().mean()) / 2)


def labelled_frames(
    tokenizer: FrameTokenizer, recording: Recording, chosen: np.ndarray, rng: np.random.Generator
) -> LabelledFrames | None:
    """Draw as many frames with success as without from episodes `chosen` (E,); None if one is missing."""
    table = recording.table
    episodes = np.repeat(np.arange(len(table.start)), table.length - 1)
    rows = np.concatenate(
        [start + np.arange(1, n) for start, n in zip(table.start, table.length, strict=True)]
    )
    success = table.shown[rows]
    classes = [np.flatnonzero(chosen[episodes] & (success == wanted)) for wanted in (True, False)]
    count = min(*map(len, classes), MAX_PROBE_FRAMES)
    if not count:
        return None
    index = np.concatenate([rng.choice(of_class, count, replace=False) for of_class in classes])
    starts = table.start[episodes[index]]
    first, images = (
        torch.cat([_small(shown) for *_, shown in reconstructions(tokenizer, recording.frames, each, starts)])
        for each in (starts, rows[index])
    )
    first, images = (each.unflatten(1, (-1, 3)) for each in (first, images))
    return LabelledFrames(first, images, torch.from_numpy(success[index]).to(images.device))


def _small(images: Tensor) -> Tensor:
    """(B, N, 3, H, W) → (B, 3N, PROBE_SIZE, PROBE_SIZE)"""
    flat = images.flatten(1, 2)
    return (
        flat if flat.shape[-1] == PROBE_SIZE else F.interpolate(flat, (PROBE_SIZE, PROBE_SIZE), mode="area")
    )
