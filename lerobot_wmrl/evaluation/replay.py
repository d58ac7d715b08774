"""Open-loop replay of recorded episodes: imagined from their first frame, with their own actions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frame_cache import depth_at, frames_to_tensor
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.open_loop import imagined_steps
from lerobot_wmrl.world_models.world_model import WorldModelRewardModel

DELTA_PSNR_STEP = 15
"""Imagined frames after which delta-PSNR is measured, as in RoboScape."""

MAX_ACTIONS = 300
"""Actions of an episode that are replayed at most."""

BATCH = 64


@dataclass(frozen=True)
class Recording:
    """Recorded episodes: their table, and all their frames, uint8 (rows, N, H, W, 3)."""

    table: EpisodeTable
    frames: np.ndarray

    def rows(self, episode: int) -> slice:
        """Return the rows of the episode that are replayed, at most `MAX_ACTIONS`."""
        start = int(self.table.start[episode])
        return slice(start, start + min(int(self.table.length[episode]), MAX_ACTIONS))

    def images(self, episode: int, device: torch.device) -> Tensor:
        """Return the frames of those rows, (T, N, 3, H, W) in [0, 1]."""
        return frames_to_tensor(self.frames[self.rows(episode)]).to(device)

    @torch.no_grad()
    def first_frames(self, episodes: np.ndarray, tokenizer: FrameTokenizer) -> tuple[Tensor, Context]:
        """Encode the first frames of E episodes: tokens (E, S), and their context."""
        device = next(tokenizer.parameters()).device
        images = frames_to_tensor(self.frames[self.table.start[episodes]]).to(device)
        context = tokenizer.context(images)
        return tokenizer.encode(images, context), context

    def first_state(self, episodes: np.ndarray, device: torch.device) -> Tensor:
        """Return the proprioception of the first frames, (E, P)."""
        return torch.from_numpy(self.table.state[self.table.start[episodes]]).to(device)

    def first_depth(self, model: WorldModelRewardModel, episodes: np.ndarray) -> Tensor | None:
        """Return the depth of the first frames, (E, S) metres, if the model looks at depth."""
        return depth_at(model, self.table.dataset, self.table.start[episodes])

    def actions(self, episodes: np.ndarray, steps: int, device: torch.device) -> Tensor:
        """Return the first `steps` actions of E episodes; short episodes repeat their last. (E, steps, A)"""
        offset = np.minimum(np.arange(steps), self.table.length[episodes][:, None] - 1)
        return torch.from_numpy(self.table.action[self.table.start[episodes][:, None] + offset]).to(device)


class ImaginedFrames(NamedTuple):
    """Imagined frames after each action of B episodes; row t belongs to recorded frame t + 1.

    Attributes:
        tokens: (B, T, S).
        done_probability: (B, T).
        proprioception: (B, T, P).
        depth: (B, T, S) metres of each token, (B, T, 0) if the model does not predict it.
    """

    tokens: Tensor
    done_probability: Tensor
    proprioception: Tensor
    depth: Tensor


@dataclass(frozen=True)
class EpisodeReplay:
    """Open-loop prediction of one episode of T actions; row t belongs to recorded frame t + 1.

    Args:
        episode: its index.
        context: of its first frame, one row.
        tokens: (T, S).
        done_probability: (T,).
        proprioception: (T, P).
        shuffled: (S,), the frame at `DELTA_PSNR_STEP` under the actions of another episode; None where there
            is none.
        done: (T,), recorded success after each action.
        depth: recorded and imagined depth, each (T − 1, N, g, g) metres on the tokens' grids; None unless the
            model predicts it.
    """

    episode: int
    context: Context
    tokens: Tensor
    done_probability: Tensor
    proprioception: Tensor
    shuffled: Tensor | None
    done: np.ndarray
    depth: tuple[Tensor, Tensor] | None = None


@torch.no_grad()
def imagine_frames(
    model: ActionWorldModelRewardModel, tokens: Tensor, state: Tensor, actions: Tensor,
    depth: Tensor | None = None, context: Context = NO_CONTEXT,
) -> ImaginedFrames:  # fmt: skip
    """Imagine every frame from tokens (B, S), state (B, P), depth (B, S) and context with actions (B, T, A).

    The noise is the same at every call.
    """
    generator = torch.Generator(tokens.device).manual_seed(0)
    steps = imagined_steps(model, tokens, state, actions, context, depth, generator)
    return ImaginedFrames(
        torch.stack([step.tokens for step in steps], 1),
        torch.stack([step.done_logit.sigmoid() for step in steps], 1),
        torch.stack([step.proprioception for step in steps], 1),
        torch.stack([step.depth for step in steps], 1),
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
    others = np.roll(episodes, 1)
    with tqdm(total=len(episodes), desc="Replaying episodes", unit="episode") as bar:
        for part in in_batches(by_length):
            for replay in _replay_batch(model, recording, episodes[part], others[part]):
                yield replay
                bar.update()


def _replay_batch(
    model: ActionWorldModelRewardModel, recording: Recording, episodes: np.ndarray, others: np.ndarray
) -> Iterator[EpisodeReplay]:
    device, table = model.state_mean.device, recording.table
    longest = min(int(table.length[episodes].max()), MAX_ACTIONS)
    tokens, context = recording.first_frames(episodes, model.tokenizer)
    state, depth = recording.first_state(episodes, device), recording.first_depth(model, episodes)
    own = imagine_frames(model, tokens, state, recording.actions(episodes, longest, device), depth, context)
    comparable = (table.length[episodes] > DELTA_PSNR_STEP) & (episodes != others)
    if comparable.any():
        actions = recording.actions(others, DELTA_PSNR_STEP, device)
        shuffled = imagine_frames(model, tokens, state, actions, depth, context).tokens[:, -1]
    for row, episode in enumerate(episodes.tolist()):
        rows = recording.rows(episode)
        steps = slice(0, rows.stop - rows.start)
        yield EpisodeReplay(
            episode, context[[row]], own.tokens[row, steps], own.done_probability[row, steps],
            own.proprioception[row, steps], shuffled[row] if comparable[row] else None, table.done[rows],
            recorded_and_imagined_depth(model, recording, rows, own.depth[row, steps]),
        )  # fmt: skip


def recorded_and_imagined_depth(
    model: ActionWorldModelRewardModel, recording: Recording, rows: slice, imagined: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Return the depth of the frames after the first of these rows on the tokens' grids.

    Args:
        imagined: metres after each row's action, (T, S).

    Returns:
        Recorded and imagined depth, each (T − 1, N, g, g); None unless the model looks at depth.
    """
    recorded = depth_at(model, recording.table.dataset, rows)
    if recorded is None:
        return None
    grids = (model.tokenizer.num_cameras, model.tokenizer.grid, model.tokenizer.grid)
    return recorded[1:].unflatten(1, grids), imagined[:-1].unflatten(1, grids)
