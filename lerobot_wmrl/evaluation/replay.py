"""Open-loop replay of recorded episodes: imagined from their first frame, with their own actions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.data.frames import Context, Frames
from lerobot_wmrl.data.lazy_rows import LazyRows
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    WorldModelRewardModel,
)

DELTA_PSNR_SECONDS = 0.6
"""Imagined time after which delta-PSNR is measured: RoboScape's 15 frames, at 25 a second."""

COMPARED_FRAMES = 300
"""Frames of an episode that are compared with imagined ones at most. Outcomes are those of whole episodes."""

BATCH = 64


@dataclass(frozen=True)
class Recording:
    """Recorded episodes: their table, and their frames.

    Args:
        table: the episodes.
        frames: uint8 (rows, N, H, W, 3).
        chosen: mask of the episodes whose frames may be read; by default all. (E,)
    """

    table: EpisodeTable
    frames: LazyRows
    chosen: np.ndarray | None = None

    @classmethod
    def read(cls, table: EpisodeTable, model: Any, chosen: np.ndarray | None = None) -> "Recording":
        """Open the frames of the cameras that a world model looks at, at its size."""
        cameras, size = model.config.tokenizer.camera_keys, model.config.tokenizer.image_size
        return cls(table, cached_frames(table.dataset, cameras, size), chosen)

    @property
    def readable(self) -> np.ndarray:
        """Mask of the episodes whose frames may be read. (E,)"""
        return np.ones(len(self.table.start), bool) if self.chosen is None else self.chosen

    def rows(self, episode: int) -> slice:
        """Return the rows of an episode."""
        (rows,) = self.table.rows([episode])
        return rows

    def compared_rows(self, episode: int) -> slice:
        """Return the rows whose frames are compared with imagined ones, the first `COMPARED_FRAMES`."""
        rows = self.rows(episode)
        return slice(rows.start, min(rows.stop, rows.start + COMPARED_FRAMES))

    def images(self, episode: int, device: torch.device) -> Tensor:
        """Return the frames of those rows, (T, N, 3, H, W) in [0, 1]."""
        return frames_to_tensor(self.frames[self.compared_rows(episode)]).to(device)

    def steps(self, seconds: float) -> int:
        """Return how many steps of the dataset take so long, at least one."""
        return max(1, round(seconds * self.table.dataset.meta.fps))

    @torch.no_grad()
    def first_frames(self, episodes: np.ndarray, tokenizer: FrameTokenizer) -> tuple[Tensor, Context]:
        """Encode the first frames of E episodes: tokens (E, S), and their context."""
        device = tokenizer.device
        images = frames_to_tensor(self.frames[self.table.start[episodes]]).to(device)
        context = tokenizer.context(images)
        return tokenizer.encode(images, context), context

    def starts(self, model: WorldModelRewardModel, episodes: np.ndarray) -> Frames:
        """Return the first frames of E episodes as the model sees them."""
        tokens, context = self.first_frames(episodes, model.tokenizer)
        rows = self.table.start[episodes]
        state = torch.from_numpy(self.table.state[rows]).to(tokens.device)
        instructions = [self.table.instructions[episode] for episode in episodes]
        return Frames(
            tokens,
            state,
            context,
            model.recorded_depth(self.table.dataset, rows),
            model.instruction_weights(instructions, len(episodes)),
        )

    def actions(self, episodes: np.ndarray, steps: int, device: torch.device) -> Tensor:
        """Return the first `steps` actions of E episodes; short episodes repeat their last. (E, steps, A)"""
        offset = np.minimum(np.arange(steps), self.table.length[episodes][:, None] - 1)
        return torch.from_numpy(self.table.action[self.table.start[episodes][:, None] + offset]).to(device)


class ImaginedFrames(NamedTuple):
    """Imagined frames after each action of B episodes; row t belongs to recorded frame t + 1.

    Attributes:
        tokens: (B, T, S).
        done_probability: (B, T).
        state: (B, T, P).
        depth: (B, T, S) metres of each token, None if the model does not predict it.
    """

    tokens: Tensor
    done_probability: Tensor
    state: Tensor
    depth: Tensor | None


@dataclass(frozen=True)
class EpisodeReplay:
    """Open-loop prediction of one episode of T actions; row t belongs to recorded frame t + 1.

    Pictures, states and depth are those of C actions, at most `COMPARED_FRAMES`.

    Args:
        episode: its index.
        context: context of its first frame, one row.
        tokens: (C, S).
        done_probability: (T,).
        state: (C, P).
        shuffled: (S,), the frame after `DELTA_PSNR_SECONDS` under the actions of another episode; None where
            there is none.
        done: (T,), recorded success after each action.
        depth: recorded and imagined depth, each (C − 1, N, g, g) metres on the tokens' grids; None unless the
            model predicts it.
    """

    episode: int
    context: Context
    tokens: Tensor
    done_probability: Tensor
    state: Tensor
    shuffled: Tensor | None
    done: np.ndarray
    depth: tuple[Tensor, Tensor] | None = None


@torch.no_grad()
def imagine_frames(model: ActionWorldModelRewardModel, frames: Frames, actions: Tensor) -> ImaginedFrames:
    """Imagine every frame from B first ones on, with actions (B, T, A)."""
    steps = model.imagine(frames, actions)
    depth = [step.depth for step in steps if step.depth is not None]
    return ImaginedFrames(
        torch.stack([step.tokens for step in steps], 1),
        torch.stack([step.done_logit.sigmoid() for step in steps], 1),
        torch.stack([step.state for step in steps], 1),
        torch.stack(depth, 1) if depth else None,
    )


def in_batches(episodes: np.ndarray) -> list[np.ndarray]:
    """Split into batches of at most `BATCH` episodes."""
    return [episodes[begin : begin + BATCH] for begin in range(0, len(episodes), BATCH)]


def replay_episodes(
    model: ActionWorldModelRewardModel, recording: Recording, episodes: np.ndarray
) -> Iterator[EpisodeReplay]:
    """Replay the episodes open loop, short ones first, with one batch of imagined tokens in memory at a time.

    Each is also imagined with the actions of the one before it in `episodes`, for delta-PSNR.
    """
    by_length = np.argsort(recording.table.length[episodes], kind="stable")
    previous = np.roll(episodes, 1)
    with tqdm(total=len(episodes), desc="Replaying episodes", unit="episode") as bar:
        for part in in_batches(by_length):
            for replay in _replay_batch(model, recording, episodes[part], previous[part]):
                yield replay
                bar.update()


def _replay_batch(
    model: ActionWorldModelRewardModel, recording: Recording, episodes: np.ndarray, previous: np.ndarray
) -> Iterator[EpisodeReplay]:
    device, table = model.device, recording.table
    longest, until = int(table.length[episodes].max()), recording.steps(DELTA_PSNR_SECONDS)
    frames = recording.starts(model, episodes)
    actions = recording.actions(episodes, longest, device)
    imagined = imagine_frames(model, frames, actions[:, :COMPARED_FRAMES])
    probability = imagined.done_probability
    if longest > COMPARED_FRAMES:
        probability = model.open_loop(frames, actions, with_tokens=False).done_logit.sigmoid()
    comparable = (table.length[episodes] > until) & (episodes != previous)
    if comparable.any():
        other = recording.actions(previous, until, device)
        shuffled = imagine_frames(model, frames, other).tokens[:, -1]
    for row, episode in enumerate(episodes.tolist()):
        rows, shown = recording.rows(episode), recording.compared_rows(episode)
        steps = slice(0, shown.stop - shown.start)
        yield EpisodeReplay(
            episode,
            frames.context[[row]],
            imagined.tokens[row, steps],
            probability[row, : rows.stop - rows.start],
            imagined.state[row, steps],
            shuffled[row] if comparable[row] else None,
            table.done[rows],
            recorded_and_imagined_depth(
                model, recording, shown, None if imagined.depth is None else imagined.depth[row, steps]
            ),
        )


def recorded_and_imagined_depth(
    model: ActionWorldModelRewardModel, recording: Recording, rows: slice, imagined: Tensor | None
) -> tuple[Tensor, Tensor] | None:
    """Return the depth of the frames after the first of these rows on the tokens' grids.

    Args:
        imagined: metres after each row's action, (T, S), if the model predicts depth.

    Returns:
        Recorded and imagined depth, each (T − 1, N, g, g); None unless the model looks at depth.
    """
    recorded = model.recorded_depth(recording.table.dataset, rows)
    if recorded is None or imagined is None:
        return None
    grids = (model.tokenizer.num_cameras, model.tokenizer.grid, model.tokenizer.grid)
    return recorded[1:].unflatten(1, grids), imagined[:-1].unflatten(1, grids)
