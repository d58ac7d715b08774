"""A probe that says whether the simulator's success condition holds in a picture.

It is a small CNN trained on real frames, labelled by the dataset's own `next.success`. It sees them as the
tokenizer draws them, since it is asked about frames that only exist so, and each beside its episode's first
frame, since success can depend on where things were.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import trange

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.evaluation.replay import Source
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer

HELD_OUT_EVERY = 5
"""Every fifth episode is held out from the probe's training, those that world models hold out among them."""

MOST_FRAMES = 1500
"""Of each class in training, and of each in the held-out check."""

SIZE = 64
EPOCHS = 10
BATCH = 64
LEARNING_RATE = 1e-3
ENCODE_BATCH = 128


class SuccessProbe(nn.Module):
    """First frame and frame (B, N, 3, H, W) in [0, 1], both decoded → the logit of success (B,)."""

    def __init__(self, num_cameras: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(6 * num_cameras, 32, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(32, 48, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(48, 64, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Dropout(0.2), nn.Linear(64 * (SIZE // 8) ** 2, 64), nn.ReLU(), nn.Linear(64, 1),
        )  # fmt: skip

    def forward(self, first: Tensor, images: Tensor) -> Tensor:
        return self.layers(torch.cat([_small(first), _small(images)], 1) - 0.5)[:, 0]


@dataclass(frozen=True)
class TrainedProbe:
    """The probe and how far to believe it: balanced accuracy on episodes it has not seen, NaN without any."""

    network: SuccessProbe
    balanced_accuracy: float
    frames: int
    held_out_frames: int

    @torch.no_grad()
    def success(self, first: Tensor, images: Tensor) -> Proportion:
        """Of decoded frames (F, N, 3, H, W), those in which success holds."""
        holds = self.network(first, images) > 0
        return Proportion(int(holds.sum()), len(holds))

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


def train_probe(tokenizer: FrameTokenizer, source: Source) -> TrainedProbe | None:
    """Train on as many successes as other frames. None if either is missing. The same probe every time."""
    held_out = is_held_out(np.arange(len(source.table.start)))
    rng = np.random.default_rng(0)
    training, test = (labelled_frames(tokenizer, source, part, rng) for part in (~held_out, held_out))
    if training is None:
        return None
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = fit(SuccessProbe(tokenizer.num_cameras).to(training.images.device), training, rng)
    accuracy = balanced_accuracy(network, test) if test is not None else np.nan
    return TrainedProbe(network, accuracy, len(training.success), 0 if test is None else len(test.success))


def is_held_out(episodes: np.ndarray) -> np.ndarray:
    """Whether the probe does not train on them. (E,) → (E,) bool"""
    return episodes % HELD_OUT_EVERY == HELD_OUT_EVERY - 1


def fit(network: SuccessProbe, data: LabelledFrames, rng: np.random.Generator) -> SuccessProbe:
    """Binary cross-entropy over `EPOCHS` passes."""
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=0.01)
    for _ in trange(EPOCHS, desc="Training the success probe", unit="epoch"):
        for index in torch.from_numpy(rng.permutation(len(data.success))).split(BATCH):
            logit = network(data.first[index], data.images[index])
            loss = F.binary_cross_entropy_with_logits(logit, data.success[index].float())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return network.eval()


@torch.no_grad()
def balanced_accuracy(network: SuccessProbe, data: LabelledFrames) -> float:
    """Mean of the accuracies on successes and on other frames."""
    right = (network(data.first, data.images) > 0) == data.success
    return float((right[data.success].float().mean() + right[~data.success].float().mean()) / 2)


def labelled_frames(
    tokenizer: FrameTokenizer, source: Source, chosen: np.ndarray, rng: np.random.Generator
) -> LabelledFrames | None:
    """As many frames with success as without from the episodes in `chosen` (E,); None if a class is empty.

    `next.success` of a row speaks of the frame its action led to, which is the next row's.
    """
    table = source.table
    episodes = np.repeat(np.arange(len(table.start)), table.length - 1)
    rows = np.concatenate(
        [start + np.arange(1, n) for start, n in zip(table.start, table.length, strict=True)]
    )
    success = table.done[rows - 1]
    classes = [np.flatnonzero(chosen[episodes] & (success == wanted)) for wanted in (True, False)]
    count = min(*map(len, classes), MOST_FRAMES)
    if not count:
        return None
    index = np.concatenate([rng.choice(of_class, count, replace=False) for of_class in classes])
    starts = table.start[episodes[index]]
    first, images = (redrawn(tokenizer, source.frames, which, starts) for which in (starts, rows[index]))
    return LabelledFrames(first, images, torch.from_numpy(success[index]).to(images.device))


@torch.no_grad()
def redrawn(tokenizer: FrameTokenizer, frames: np.ndarray, rows: np.ndarray, starts: np.ndarray) -> Tensor:
    """Frames as the tokenizer draws them, as small as the probe sees them: (R,) → (R, N, 3, h, w).

    starts (R,): the first rows of their episodes.
    """
    device, drawn = next(tokenizer.parameters()).device, []
    for begin in range(0, len(rows), ENCODE_BATCH):
        part = slice(begin, begin + ENCODE_BATCH)
        images, first = (frames_to_tensor(frames[which[part]]).to(device) for which in (rows, starts))
        context = tokenizer.context(first)
        drawn.append(_small(tokenizer.decode(tokenizer.encode(images, context), context)))
    return torch.cat(drawn).unflatten(1, (-1, 3))


def _small(images: Tensor) -> Tensor:
    """(B, N, 3, H, W) → (B, 3N, SIZE, SIZE)"""
    flat = images.flatten(1, 2)
    return flat if flat.shape[-1] == SIZE else F.interpolate(flat, (SIZE, SIZE), mode="area")
