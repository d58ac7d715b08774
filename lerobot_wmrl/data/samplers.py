"""Training batches as pure functions of (seed, step): a resumed training repeats and skips no sample.

`batch_size` is a process's share: each draws the whole batch and keeps its own rows of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.distributed import own_rows, rank_and_size
from lerobot_wmrl.data.clip import Clip
from lerobot_wmrl.data.episode_table import EpisodeTable
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import NO_CONTEXT, Context


@dataclass
class ClipSampler:
    """Clips of tokens for the world models.

    tokens (rows, S) is the memory map; `episodes` the indices of the episodes to draw from; `from_start` the
    share of clips that begin with their episode. Success can depend on where the episode began (an object
    pushed 10 cm), so only these carry done labels, unless the context shows it to all.
    For models that look at them: depth (rows, S), metres of each token; context (E, N, C, g, g), of episodes'
    first frames. done_known: whether the table's done is what happened, or nobody knows.
    """

    table: EpisodeTable
    tokens: np.ndarray
    episodes: np.ndarray
    clip_length: int
    from_start: float
    batch_size: int
    seed: int
    device: str
    depth: np.ndarray | None = None
    context: np.ndarray | None = None
    done_known: bool = True

    def __call__(self, step: int) -> Clip:
        """This process's share of the batch of one training step."""
        rng, size = np.random.default_rng([self.seed, step]), self.batch_size * rank_and_size()[1]
        episodes = rng.choice(self.episodes, size)
        room = np.maximum(self.table.length[episodes] - 2, 1)
        offsets = np.where(rng.random(size) < self.from_start, 0, rng.integers(0, room))
        rows = own_rows(self.batch_size)
        return self.clips(episodes[rows], offsets[rows])

    def clips(self, episodes: np.ndarray, offsets: np.ndarray) -> Clip:
        """Rows `offset … offset + clip_length − 1` of each episode, padded with its last row."""
        rows = offsets[:, None] + np.arange(self.clip_length)
        valid = rows < self.table.length[episodes][:, None]
        rows = self.table.start[episodes][:, None] + np.minimum(
            rows, self.table.length[episodes][:, None] - 1
        )
        whole = self.context is not None
        known = valid & self.done_known & (whole | (offsets == 0))[:, None]
        context = NO_CONTEXT if self.context is None else Context((self._tensor(self.context[episodes]),))
        return Clip(
            self._tensor(self.tokens[rows]).long(),
            self._tensor(self.table.state[rows]),
            self._tensor(self.table.action[rows]),
            self._tensor(self.table.done[rows]).float(),
            self._tensor(valid),
            self._tensor(known),
            [self.table.instructions[episode] for episode in episodes],
            None if self.depth is None else self._tensor(self.depth[rows]),
            context,
        )

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)


@dataclass
class FrameSampler:
    """Single frames with their episode's first frame, for the tokenizer."""

    table: EpisodeTable
    frames: np.ndarray
    episodes: np.ndarray
    cameras: list[str]
    batch_size: int
    seed: int
    device: str

    def __call__(self, step: int) -> dict[str, Tensor]:
        """This process's share of one step's batch: `observation.images.*`, `reference.*`, (B, 3, H, W)."""
        rng = np.random.default_rng([self.seed, step])
        episodes = rng.choice(self.episodes, self.batch_size * rank_and_size()[1])
        start = self.table.start[episodes]
        rows = start + rng.integers(0, self.table.length[episodes])
        start, rows = start[own_rows(self.batch_size)], rows[own_rows(self.batch_size)]
        images, reference = (frames_to_tensor(self.frames[index]).to(self.device) for index in (rows, start))
        batch = {}
        for index, camera in enumerate(self.cameras):
            batch[f"observation.images.{camera}"] = images[:, index]
            batch[f"reference.{camera}"] = reference[:, index]
        return batch


@dataclass
class InTurn:
    """Every second batch of `first`, the ones in between of the others in turn."""

    first: ClipSampler | FrameSampler
    others: Sequence[ClipSampler | FrameSampler]

    def __call__(self, step: int) -> Any:
        """This process's share of one step's batch, as that sampler gives it."""
        if step % 2 == 0:
            return self.first(step)
        return self.others[step // 2 % len(self.others)](step)
