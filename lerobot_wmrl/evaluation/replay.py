"""Real episodes imagined open loop: from their first frame, with their own actions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_wmrl.data.depth_maps import depth_at
from lerobot_wmrl.data.episode_table import EpisodeTable
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.open_loop import imagined_steps
from lerobot_wmrl.world_models.world_model import WorldModelRewardModel

DELTA_PSNR_STEP = 15
"""Imagined frames after which delta-PSNR is measured, as RoboScape does."""

LONGEST = 300
"""Actions of an episode that are replayed at most."""

BATCH = 64


class OpenLoop(NamedTuple):
    """Imagined frames after each action of B episodes: row t belongs to real frame t + 1.

    tokens (B, T, S); done_probability (B, T); proprioception (B, T, P); depth (B, T, S), metres of each
    token, (B, T, 0) if the model does not predict it.
    """

    tokens: Tensor
    done_probability: Tensor
    proprioception: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Source:
    """Real episodes: their numbers, and their frames uint8 (rows, N, H, W, 3)."""

    table: EpisodeTable
    frames: np.ndarray

    def rows(self, episode: int) -> slice:
        """The rows that are replayed: at most `LONGEST`."""
        start = int(self.table.start[episode])
        return slice(start, start + min(int(self.table.length[episode]), LONGEST))

    def images(self, episode: int, device: torch.device) -> Tensor:
        """Those rows' frames, (T, N, 3, H, W) in [0, 1]."""
        return frames_to_tensor(self.frames[self.rows(episode)]).to(device)

    @torch.no_grad()
    def starts(self, episodes: np.ndarray, tokenizer: FrameTokenizer) -> tuple[Tensor, Context]:
        """The episodes' first frames: tokens (E, S), and their context if the tokenizer asks for one."""
        device = next(tokenizer.parameters()).device
        images = frames_to_tensor(self.frames[self.table.start[episodes]]).to(device)
        context = tokenizer.context(images)
        return tokenizer.encode(images, context), context

    def first_state(self, episodes: np.ndarray, device: torch.device) -> Tensor:
        """(E, P)"""
        return torch.from_numpy(self.table.state[self.table.start[episodes]]).to(device)

    def first_depth(self, model: WorldModelRewardModel, episodes: np.ndarray) -> Tensor | None:
        """(E, S) metres, if the model looks at depth."""
        return depth_at(model, self.table.dataset, self.table.start[episodes])

    def actions(self, episodes: np.ndarray, steps: int, device: torch.device) -> Tensor:
        """The first `steps` actions of each episode, its last one repeated when it is over. (E, steps, A)"""
        offset = np.minimum(np.arange(steps), self.table.length[episodes][:, None] - 1)
        return torch.from_numpy(self.table.action[self.table.start[episodes][:, None] + offset]).to(device)


@dataclass(frozen=True)
class EpisodeReplay:
    """What the model made of one episode of T actions; row t of it belongs to real frame t + 1.

    context: of its first frame, one row; tokens (T, S); done_probability (T,); proprioception (T, P);
    shuffled (S,), the frame at `DELTA_PSNR_STEP` with the actions of another episode, None where there is
    none; done (T,), real success after each action; depth, metres (T − 1, N, g, g) on the tokens' grids, of
    the real and of the imagined frames, None unless the model predicts it.
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
def open_loop(
    model: ActionWorldModelRewardModel, tokens: Tensor, state: Tensor, actions: Tensor,
    depth: Tensor | None = None, context: Context = NO_CONTEXT,
) -> OpenLoop:  # fmt: skip
    """Imagine from tokens (B, S), state (B, P) and, if the model looks at them, depth (B, S) and context with
    actions (B, T, A). The same noise at every call."""
    generator = torch.Generator(tokens.device).manual_seed(0)
    steps = imagined_steps(model, tokens, state, actions, context, depth, generator)
    return OpenLoop(
        torch.stack([step.tokens for step in steps], 1),
        torch.stack([step.done_logit.sigmoid() for step in steps], 1),
        torch.stack([step.proprioception for step in steps], 1),
        torch.stack([step.depth for step in steps], 1),
    )


def in_batches(episodes: np.ndarray) -> list[np.ndarray]:
    """At most `BATCH` of them in each."""
    return [episodes[begin : begin + BATCH] for begin in range(0, len(episodes), BATCH)]


def replay_episodes(
    model: ActionWorldModelRewardModel, source: Source, episodes: np.ndarray
) -> Iterator[EpisodeReplay]:
    """Replay the episodes, short ones first, one batch of imagined tokens in memory at a time.

    Each is also imagined with the actions of the one before it in `episodes`, for delta-PSNR.
    """
    by_length = np.argsort(source.table.length[episodes], kind="stable")
    others = np.roll(episodes, 1)
    with tqdm(total=len(episodes), desc="Replaying episodes", unit="episode") as bar:
        for part in in_batches(by_length):
            for run in _replay_batch(model, source, episodes[part], others[part]):
                yield run
                bar.update()


def _replay_batch(
    model: ActionWorldModelRewardModel, source: Source, episodes: np.ndarray, others: np.ndarray
) -> Iterator[EpisodeReplay]:
    device, table = model.state_mean.device, source.table
    longest = min(int(table.length[episodes].max()), LONGEST)
    tokens, context = source.starts(episodes, model.tokenizer)
    state, depth = source.first_state(episodes, device), source.first_depth(model, episodes)
    own = open_loop(model, tokens, state, source.actions(episodes, longest, device), depth, context)
    comparable = (table.length[episodes] > DELTA_PSNR_STEP) & (episodes != others)
    if comparable.any():
        actions = source.actions(others, DELTA_PSNR_STEP, device)
        shuffled = open_loop(model, tokens, state, actions, depth, context).tokens[:, -1]
    for row, episode in enumerate(episodes.tolist()):
        rows = source.rows(episode)
        steps = slice(0, rows.stop - rows.start)
        yield EpisodeReplay(
            episode, context[[row]], own.tokens[row, steps], own.done_probability[row, steps],
            own.proprioception[row, steps], shuffled[row] if comparable[row] else None, table.done[rows],
            real_and_imagined_depth(model, source, rows, own.depth[row, steps]),
        )  # fmt: skip


def real_and_imagined_depth(
    model: ActionWorldModelRewardModel, source: Source, rows: slice, imagined: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Depth of the frames after the first of these rows on the tokens' grids, from metres imagined after each
    row's action (T, S). → two (T − 1, N, g, g)"""
    real = depth_at(model, source.table.dataset, rows)
    if real is None:
        return None
    grids = (model.tokenizer.num_cameras, model.tokenizer.grid, model.tokenizer.grid)
    return real[1:].unflatten(1, grids), imagined[:-1].unflatten(1, grids)
