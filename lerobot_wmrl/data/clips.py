"""Clips that world models learn from: drawn from a dataset, or made of lerobot-train's windows.

Training batches are pure functions of (seed, step): a resumed training repeats and skips no sample. Processes
that train together have seeds of their own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from lerobot.utils.constants import ACTION, DONE, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.images import camera_key
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import NO_CONTEXT, Context, Frames
from lerobot_wmrl.data.lazy_rows import LazyRows

SUCCESS_SHARE: Final = 0.05
"""Share of what is learnt that shows success, at least: where fewer frames do, they count more."""

MOST_WEIGHT: Final = 20.0
"""Weight of a frame with success in the loss of done, at most."""


class Clip(NamedTuple):
    """T consecutive frames of B episodes, with actions and success.

    Args:
        tokens: (B, T, S).
        state: (B, T, P), in dataset units.
        action: (B, T, A), in dataset units.
        done: (B, T), 1 where success holds at frame t + 1.
        valid: (B, T), False where the episode is padded.
        done_known: (B, T), False where `done` is unknown.
        instructions: B of them.
        depth: (B, T, S) metres of each token, for models that look at depth.
        context: context of the B episodes' first frames, for models that look at it.
        features: (B, T, F) of the frames, by the tokenizer's success classifier, if it has one.
        done_pos_weight: of a frame with success in the loss of done.
    """

    tokens: Tensor
    state: Tensor
    action: Tensor
    done: Tensor
    valid: Tensor
    done_known: Tensor
    instructions: list[str]
    depth: Tensor | None = None
    context: Context = NO_CONTEXT
    features: Tensor | None = None
    done_pos_weight: float = 1.0

    def first(self) -> Frames:
        """Return the clips' first frames."""
        depth = None if self.depth is None else self.depth[:, 0]
        return Frames(self.tokens[:, 0], self.state[:, 0], self.context, depth)


def take_steps(values: Tensor, index: Tensor) -> Tensor:
    """Take the steps `index` (B, K) of every clip: values (B, T, …) → (B, K, …)."""
    return values[torch.arange(len(values), device=values.device)[:, None], index]


def known_transitions(valid: Tensor) -> Tensor:
    """Mark where a valid frame follows a valid one: (B, T) → (B, T − 1)."""
    return valid[:, 1:] & valid[:, :-1]


@dataclass
class ClipSampler:
    """Draw clips of tokens for the world models.

    Success can depend on where the episode began (an object pushed 10 cm), so only clips that begin with
    their episode carry done labels, unless the context shows the beginning to all. A dataset that does not
    say where success holds gives none.

    Args:
        table: the episodes.
        tokens: (rows, S).
        episodes: indices of the episodes to draw from.
        clip_length: T.
        from_start: share of clips that begin with their episode.
        batch_size: B.
        seed: seed of the draws, another one in every process.
        device: where the clips go.
        depth: (rows, S) metres of each token, for models that look at depth.
        context: (E, N, C, g, g) of the episodes' first frames, for models that look at it.
        features: (rows, F) of the tokenizer's success classifier, for models that predict them.
    """

    table: EpisodeTable
    tokens: LazyRows
    episodes: np.ndarray
    clip_length: int
    from_start: float
    batch_size: int
    seed: int
    device: str
    depth: LazyRows | None = None
    context: LazyRows | None = None
    features: LazyRows | None = None

    def __post_init__(self) -> None:
        """Weigh success by how rare it is."""
        done = np.concatenate([self.table.success_target[rows] for rows in self.table.rows(self.episodes)])
        odds = SUCCESS_SHARE / (1 - SUCCESS_SHARE)
        rarity = float(odds * (~done).sum() / done.sum()) if done.any() else 1.0
        self.done_pos_weight = min(max(1.0, rarity), MOST_WEIGHT)

    def __call__(self, step: int) -> Clip:
        """Draw the batch of one training step."""
        rng = np.random.default_rng([self.seed, step])
        episodes = rng.choice(self.episodes, self.batch_size)
        room = np.maximum(self.table.length[episodes] - min(self.clip_length, 3) + 1, 1)
        offsets = np.where(rng.random(self.batch_size) < self.from_start, 0, rng.integers(0, room))
        return self.clips(episodes, offsets)

    def clips(self, episodes: np.ndarray, offsets: np.ndarray) -> Clip:
        """Return rows `offset … offset + clip_length − 1` of each episode, padded with its last row."""
        rows = offsets[:, None] + np.arange(self.clip_length)
        valid = rows < self.table.length[episodes][:, None]
        rows = self.table.start[episodes][:, None] + np.minimum(
            rows, self.table.length[episodes][:, None] - 1
        )
        shows_start = self.context is not None
        known = valid & self.table.has_labels & (shows_start | (offsets == 0))[:, None]
        context = NO_CONTEXT if self.context is None else Context((self._tensor(self.context[episodes]),))
        return Clip(
            tokens=self._tensor(self.tokens[rows]).long(),
            state=self._tensor(self.table.state[rows]),
            action=self._tensor(self.table.action[rows]),
            done=self._tensor(self.table.success_target[rows]).float(),
            valid=self._tensor(valid),
            done_known=self._tensor(known),
            instructions=[self.table.instructions[episode] for episode in episodes],
            depth=None if self.depth is None else self._tensor(self.depth[rows]),
            context=context,
            features=None if self.features is None else self._tensor(self.features[rows]),
            done_pos_weight=self.done_pos_weight,
        )

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)


@dataclass
class FrameSampler:
    """Draw single frames, each with its episode's first frame, for the tokenizer.

    Args:
        table: the episodes.
        frames: (rows, N, H, W, 3) uint8.
        episodes: indices of the episodes to draw from.
        cameras: N names.
        batch_size: B.
        seed: seed of the draws, another one in every process.
        device: where the frames go.
    """

    table: EpisodeTable
    frames: LazyRows
    episodes: np.ndarray
    cameras: list[str]
    batch_size: int
    seed: int
    device: str

    def __post_init__(self) -> None:
        """Find the frames that show success, and the share of draws that must fall on them besides."""
        self.shown = self.table.shown
        offsets = [np.flatnonzero(self.shown[rows]) for rows in self.table.rows(self.episodes)]
        counts, length = np.array([len(each) for each in offsets]), self.table.length[self.episodes]
        self.solved_episodes = np.repeat(self.episodes, counts)
        self.solved_offsets = np.concatenate(offsets)
        share = float((counts / length).mean())
        self.extra = max(0.0, (SUCCESS_SHARE - share) / (1 - share)) if counts.any() else 0.0

    def __call__(self, step: int) -> dict[str, Any]:
        """Draw the batch of one step.

        `observation.images.*` and `reference.*`, (B, 3, H, W) each; `success` (B,), whether it holds; and
        `task`, the instructions.
        """
        rng = np.random.default_rng([self.seed, step])
        episodes = rng.choice(self.episodes, self.batch_size)
        offsets = rng.integers(0, self.table.length[episodes])
        if self.extra:
            extra = rng.random(self.batch_size) < self.extra
            solved = rng.integers(0, len(self.solved_offsets), self.batch_size)
            episodes = np.where(extra, self.solved_episodes[solved], episodes)
            offsets = np.where(extra, self.solved_offsets[solved], offsets)
        start = self.table.start[episodes]
        rows = start + offsets
        images, reference = (frames_to_tensor(self.frames[index]).to(self.device) for index in (rows, start))
        batch: dict[str, Any] = {
            "success": torch.from_numpy(self.shown[rows]).to(self.device),
            "task": [self.table.instructions[episode] for episode in episodes],
        }
        for index, camera in enumerate(self.cameras):
            batch[camera_key(camera)] = images[:, index]
            batch[f"reference.{camera}"] = reference[:, index]
        return batch


@dataclass
class InTurn:
    """Take every second batch from `first`, the ones in between from `more` in turn."""

    first: ClipSampler | FrameSampler
    more: Sequence[ClipSampler | FrameSampler]

    def __call__(self, step: int) -> Any:
        """Draw the batch of one step from the sampler whose turn it is."""
        if step % 2 == 0:
            return self.first(step)
        return self.more[step // 2 % len(self.more)](step)


def window_actions(
    batch: Mapping[str, Any], rows: int, length: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the actions (B, T, A) of windows, and which of these begin with their episode (B, 1).

    Args:
        batch: as in `clip_from_windows`.
        rows, length: B and T.

    Raises:
        ValueError: the action is missing or has another length than the frames.
    """
    action, begins = batch.get(ACTION), torch.zeros(rows, 1, dtype=torch.bool, device=device)
    if action is not None and action.shape in ((rows, length), (rows, length + 1)):
        action = action[..., None]
    if action is not None and action.ndim == 3 and action.shape[1] == length + 1:
        action = action[:, 1:]  # where there is none before the window, it begins with its episode
        begins = batch.get(f"{ACTION}_is_pad", begins).to(device)[:, :1]
    if action is None or action.ndim != 3 or action.shape[1] != length:
        shape = "none" if action is None else f"shape {tuple(action.shape)}"
        raise ValueError(f"action: {shape}, but the batch has windows of {length} frames; give one a frame")
    return action, begins


def clip_from_windows(
    tokens: Tensor,
    batch: Mapping[str, Any],
    camera_key: str,
    state_size: int,
    depth: Tensor | None = None,
    features: Tensor | None = None,
) -> Clip:
    """Make clips of windows as lerobot-train gives them.

    A window ends at its row of the dataset. LeRobot fills a window that would begin before its episode with
    copies of the first row. These move to the window's end and become invalid: otherwise the model would
    learn that actions at the start of an episode have no effect. The batch has `next.done` of the last row
    alone. As in `ClipSampler`, it is a label only in windows that contain their episode's start.

    Args:
        tokens: (B, T, S), of the windows' frames.
        batch: action (B, T, A), or (B, 1 + T, A) with the action before the window; observation.state
            (B, T, P). Both may lack the last axis if A or P is 1. Further next.done (B,) or (B, 1), task, and
            `*_is_pad`, (B, T) or (B, 1 + T) as what it is about. All but the action may be missing.
        camera_key: the camera whose padding counts.
        state_size: P, 0 for a model without `observation.state`.
        depth: (B, T, S) metres, of the windows' frames.
        features: (B, T, F), of the windows' frames.

    Raises:
        ValueError: the action is missing or has another length than the frames; NaN or infinity in a number.
    """
    (rows, length), device = tokens.shape[:2], tokens.device
    action, begins = window_actions(batch, rows, length, device)
    state = batch[OBS_STATE].reshape(rows, length, -1) if state_size else action.new_zeros(rows, length, 0)
    require_finite(action, state)
    padded = batch.get(f"{camera_key}_is_pad", torch.zeros(rows, length, dtype=torch.bool)).to(device)
    before, index = padded.sum(1, keepdim=True), unpadded_rows(padded)
    begins = begins | (before > 0)
    steps = torch.arange(length, device=device)
    done, known = window_labels(batch, steps == length - 1 - before, begins)
    tokens, state, action = (take_steps(values, index) for values in (tokens, state, action))
    depth, features = (each if each is None else take_steps(each, index) for each in (depth, features))
    return Clip(
        tokens=tokens,
        state=state,
        action=action,
        done=done,
        valid=steps < length - before,
        done_known=known,
        instructions=list(batch.get("task", [""] * rows)),
        depth=depth,
        features=features,
    )


def window_labels(batch: Mapping[str, Any], last: Tensor, begins: Tensor) -> tuple[Tensor, Tensor]:
    """Return a window's labels of success, and where they count: at the last row of those that contain their
    episode's start. last: (B, T); begins: (B, T) or (B, 1)."""
    if not isinstance(batch.get(DONE), Tensor):  # LeRobot's processors put False where the dataset has none
        return torch.zeros_like(last, dtype=torch.float), torch.zeros_like(last)
    return last * batch[DONE].reshape(len(last), 1).float(), last & begins


def require_finite(action: Tensor, state: Tensor) -> None:
    """Raise ValueError if a clip's actions or states hold NaN or infinity."""
    for name, values in ((ACTION, action), (OBS_STATE, state)):
        if not torch.isfinite(values).all():
            raise ValueError(f"{name}: holds NaN or infinity; remove the episodes that do from the dataset")


def unpadded_rows(padded: Tensor) -> Tensor:
    """Return the row of the window for each row of the clip, past the padding in front. (B, T) → (B, T)"""
    length = padded.shape[1]
    return (torch.arange(length, device=padded.device) + padded.sum(1, keepdim=True)).clamp(max=length - 1)
