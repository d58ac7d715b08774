"""Goal frames of the text world model: distance to recorded final frames, and whether success holds in them.

The second question is answered by a success probe: a small CNN trained on recorded frames, labelled by the
dataset's own `next.success`. It sees every frame as the tokenizer decodes it, because goal frames exist only
decoded, and beside its episode's first frame, because success can depend on where things were.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import trange

from lerobot_wmrl.common.statistics import Estimate, Proportion, evenly_spaced
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.evaluation.image_metrics import psnr
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel

MAX_FINALS = 200

PROBE_VALIDATION_EVERY = 5
"""Every fifth episode is held out from the probe's training, those that world models hold out among them."""

MAX_PROBE_FRAMES = 1500
"""Frames of each class in the probe's training, and of each in its validation."""

PROBE_SIZE = 64
PROBE_EPOCHS = 10
PROBE_BATCH = 64
PROBE_LEARNING_RATE = 1e-3
ENCODE_BATCH = 128


class Finals(NamedTuple):
    """Recorded final frames of F successful episodes.

    Attributes:
        episodes: their indices (F,).
        images: the frames in which success begins, decoded (F, N, 3, H, W).
        starts: the first frames of those episodes, decoded (F, N, 3, H, W).
        features: decoder features of `images`.
    """

    episodes: np.ndarray
    images: Tensor
    starts: Tensor
    features: list[Tensor]


@dataclass(frozen=True)
class Goals:
    """Goal frames of G episodes beside recorded final frames; images are decoded, (G, N, 3, H, W) in [0, 1].

    Args:
        episodes: the episodes (G,) from whose first frames the goals are imagined.
        start, goal: the first frames and the goal frames.
        reached: whether the done threshold was reached, (G,).
        finals: recorded final frames, None without a success.
        nearest: index into `finals` of the nearest one with the same instruction by feature distance, −1
            without one, (G,).
        distance, start_distance: least feature distance of the goal and of the start, (G,).
    """

    episodes: np.ndarray
    start: Tensor
    goal: Tensor
    reached: np.ndarray
    finals: Finals | None
    nearest: np.ndarray
    distance: np.ndarray
    start_distance: np.ndarray


@torch.no_grad()
def imagine_goals(model: TextWorldModelRewardModel, recording: Recording, episodes: np.ndarray) -> Goals:
    """Imagine goals from the first frames of episodes (G,) and find the nearest finals."""
    tokenizer = model.tokenizer
    frames = recording.starts(model, episodes)
    instructions = [recording.table.instructions[episode] for episode in episodes]
    goal = imagine_goal(model, frames, instructions)
    start = tokenizer.decode_with_features(frames.tokens, frames.context)
    finals = final_frames(tokenizer, recording)
    nearest, distance = np.full(len(episodes), -1), np.full(len(episodes), np.nan)
    start_distance = distance
    if finals is not None:
        same = np.array(
            [[recording.table.instructions[f] == text for f in finals.episodes] for text in instructions]
        )
        pairs = feature_distances(goal.decoded.features, finals.features, tokenizer.num_cameras)
        distance, nearest = least(pairs, same)
        pairs = feature_distances(start.features, finals.features, tokenizer.num_cameras)
        start_distance = least(pairs, same)[0]
    return Goals(
        episodes, start.images, goal.decoded.images, goal.reached.cpu().numpy(), finals,
        nearest, distance, start_distance,
    )  # fmt: skip


def goal_quality(goals: Goals, probe: "TrainedProbe | None") -> dict[str, Any]:
    """Return the distances of goals and starts to the nearest finals, and the probe's share of successes."""
    result = {
        "goals": len(goals.episodes),
        "goal_reached": Proportion(int(goals.reached.sum()), len(goals.reached)).as_json(),
        "nearest_final_tokenizer_lpips": Estimate.mean(goals.distance).as_json(),
        "start_to_final_tokenizer_lpips": Estimate.mean(goals.start_distance).as_json(),
        "nearest_final_psnr": Estimate.mean(nearest_psnr(goals)).as_json(),
    }
    if probe is not None and goals.finals is not None:
        unseen = held_out_from_probe(goals.finals.episodes)
        result["success_holds"] = probe.success(goals.start, goals.goal).as_json()
        result["success_holds_in_finals"] = probe.success(
            goals.finals.starts[unseen], goals.finals.images[unseen]
        ).as_json()
        result["probe"] = probe.as_json()
    return result


def nearest_psnr(goals: Goals) -> np.ndarray:
    """PSNR in dB between each goal and the final nearest to it, for the goals that have one."""
    if goals.finals is None:
        return np.empty(0)
    known = goals.nearest >= 0
    return psnr(goals.goal[known], goals.finals.images[goals.nearest[known]]).cpu().numpy()


def final_frames(tokenizer: FrameTokenizer, recording: Recording) -> Finals | None:
    """Decode the recorded final frames, None if no episode succeeds."""
    episodes, rows = final_rows(recording)
    if not len(episodes):
        return None
    first, context = recording.first_frames(episodes, tokenizer)
    images = frames_to_tensor(recording.frames[rows]).to(first.device)
    tokens = first, tokenizer.encode(images, context)
    starts, decoded = (tokenizer.decode_with_features(each, context) for each in tokens)
    return Finals(episodes, decoded.images, starts.images, decoded.features)


def final_rows(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `MAX_FINALS` successful episodes and the rows of their first frames with success."""
    table = recording.table
    episodes = table.success.nonzero()[0]
    episodes = episodes[evenly_spaced(len(episodes), MAX_FINALS)]
    rows = [
        min(each.start + int(table.done[each].argmax()) + 1, each.stop - 1) for each in table.rows(episodes)
    ]
    return episodes, np.array(rows, int)


def feature_distances(goals: Sequence[Tensor], finals: Sequence[Tensor], num_cameras: int) -> np.ndarray:
    """LPIPS's formula on tokenizer features for every pair, averaged over N cameras.

    [(G·N, C, h, w)] and [(F·N, C, h, w)] → (G, F).
    """
    count = len(finals[0]) // num_cameras
    rows = []
    for goal in zip(*(layer.split(num_cameras) for layer in goals), strict=True):
        spread = [layer.repeat(count, 1, 1, 1) for layer in goal]
        rows.append(feature_distance(spread, finals).unflatten(0, (count, num_cameras)).mean(1))
    return torch.stack(rows).cpu().numpy()


def least(distance: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each row's least allowed value and its column; NaN and −1 where none is allowed. (G, F)"""
    masked = np.where(allowed, distance, np.inf)
    index, some = masked.argmin(1), allowed.any(1)
    return np.where(some, masked.min(1), np.nan), np.where(some, index, -1)


class SuccessProbe(nn.Module):
    """First frame and frame (B, N, 3, H, W) in [0, 1], both decoded → the logit of success (B,)."""

    def __init__(self, num_cameras: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(6 * num_cameras, 32, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(32, 48, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(48, 64, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Dropout(0.2), nn.Linear(64 * (PROBE_SIZE // 8) ** 2, 64), nn.ReLU(),
            nn.Linear(64, 1),
        )  # fmt: skip

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


def train_probe(tokenizer: FrameTokenizer, recording: Recording) -> TrainedProbe | None:
    """Train on as many frames with success as without, with a fixed seed. None if a class is empty."""
    held_out = held_out_from_probe(np.arange(len(recording.table.start)))
    rng = np.random.default_rng(0)
    training, test = (labelled_frames(tokenizer, recording, part, rng) for part in (~held_out, held_out))
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
    first, images = (decoded(tokenizer, recording.frames, which, starts) for which in (starts, rows[index]))
    return LabelledFrames(first, images, torch.from_numpy(success[index]).to(images.device))


@torch.no_grad()
def decoded(tokenizer: FrameTokenizer, frames: np.ndarray, rows: np.ndarray, starts: np.ndarray) -> Tensor:
    """Encode and decode recorded frames, at the probe's size: rows (R,) → (R, N, 3, h, w).

    starts (R,): the first rows of their episodes.
    """
    device, parts = next(tokenizer.parameters()).device, []
    for begin in range(0, len(rows), ENCODE_BATCH):
        part = slice(begin, begin + ENCODE_BATCH)
        images, first = (frames_to_tensor(frames[which[part]]).to(device) for which in (rows, starts))
        context = tokenizer.context(first)
        parts.append(_small(tokenizer.decode(tokenizer.encode(images, context), context)))
    return torch.cat(parts).unflatten(1, (-1, 3))


def _small(images: Tensor) -> Tensor:
    """(B, N, 3, H, W) → (B, 3N, PROBE_SIZE, PROBE_SIZE)"""
    flat = images.flatten(1, 2)
    return (
        flat if flat.shape[-1] == PROBE_SIZE else F.interpolate(flat, (PROBE_SIZE, PROBE_SIZE), mode="area")
    )
