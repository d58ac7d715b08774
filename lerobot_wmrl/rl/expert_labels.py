"""Observations labelled with an expert's actions, which distillation imitates: the planner's in imagination,
those of recorded successes. In memory and on disk. N labels, n steps of a window.
"""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lerobot_wmrl.common.constants import INSTRUCTIONS, Observation
from lerobot_wmrl.common.errors import FieldError, TrainingStopped, first_line
from lerobot_wmrl.common.images import stretch
from lerobot_wmrl.common.pipeline import ACTION_IS_PAD
from lerobot_wmrl.data.decoding import decode, rows_of
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.start_frames import every_chosen_episode
from lerobot_wmrl.rl.observations import ObservationBuffer, as_policy_input

ROWS = "rows"
"""Name of `ExpertLabelBatch.rows` in a file of labels."""


@dataclass(frozen=True)
class Windows:
    """Which observations and actions around a step a policy learns from, as it tells LeRobot's datasets.

    Args:
        observations: their distances from the step (`observation_delta_indices`), none above 0 and the last
            one 0; None for the step's own observation, without an axis of time.
        actions: those of the actions (`action_delta_indices`), of a chunk for example; None for the step's
            own.
    """

    observations: list[int] | None = None
    actions: list[int] | None = None

    @classmethod
    def of(cls, policy: PreTrainedConfig) -> "Windows":
        """Return those of a policy."""
        return cls(policy.observation_delta_indices, policy.action_delta_indices)


@dataclass(frozen=True)
class ExpertLabelBatch:
    """N labels from one place, whose windows share F observations.

    Args:
        observations: images as bytes and `task` as an index into the instructions; (F, …) each.
        actions: `action`, (N, A) or windows (N, n, A), and for windows `action_is_pad` (N, n).
        rows: which observations belong to each label, (N,) or windows (N, n).
        instructions: instructions of the tasks.
    """

    observations: dict[str, Tensor]
    actions: dict[str, Tensor]
    rows: Tensor
    instructions: list[str]

    def __len__(self) -> int:
        return len(self.rows)

    def batch(self, labels: Tensor) -> dict[str, Any]:
        """Return some of the labels, as LeRobot's datasets would give them: images in [0, 1]."""
        rows = self.rows[labels]
        last = rows if rows.ndim == 1 else rows[:, -1]
        observations = {
            name: value[last if name == INSTRUCTIONS else rows] for name, value in self.observations.items()
        }
        actions = {name: value[labels] for name, value in self.actions.items()}
        return as_policy_input(observations | actions, self.instructions)


class ExpertLabels:
    """Labels of recorded successes, and of each iteration's imagined episodes, one file an iteration, so that
    a resumed training has them.

    Args:
        folder: folder of the files.
        process: number of this process, which has files of its own.
    """

    def __init__(self, folder: Path, process: int) -> None:
        self.folder, self.process = folder, process
        self.recorded: list[ExpertLabelBatch] = []
        self.imagined: list[ExpertLabelBatch] = []

    def __len__(self) -> int:
        return sum(map(len, (*self.recorded, *self.imagined)))

    def path(self, iteration: int) -> Path:
        """Return the file of an iteration."""
        return self.folder / f"{iteration:06d}-{self.process}.safetensors"

    def add(self, iteration: int, part: ExpertLabelBatch) -> None:
        """Add an iteration's labels, on disk first.

        Raises:
            TrainingStopped: they do not fit into memory beside those of the iterations before.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = self.path(iteration).with_suffix(".partial")
        tensors = {**part.observations, **part.actions, ROWS: part.rows}
        size, free = sum(each.nbytes for each in tensors.values()), psutil.virtual_memory().available
        if local_processes() * size > free:
            raise TrainingStopped(
                f"iteration {iteration + 1}: the frames of its labels take {size / 1e9:.1f} GB of memory in "
                f"each process, and {free / 1e9:.1f} GB are free beside those of the iterations before; the "
                "last checkpoint is kept: lower `num_envs` or `iterations`"
            )
        kept = {name: value.cpu().contiguous() for name, value in tensors.items()}
        save_file(kept, partial, {"instructions": json.dumps(part.instructions)})
        partial.replace(self.path(iteration))
        self._append(kept, part.instructions)

    def load(self, iterations: int) -> None:
        """Read the labels of the iterations before `iterations`, in place of those in memory.

        Raises:
            ValueError: a file is missing or truncated.
        """
        self.imagined = []
        for iteration in range(iterations):
            try:
                with safe_open(self.path(iteration), framework="pt") as file:
                    tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                    self._append(tensors, json.loads(file.metadata()["instructions"]))
            except (SafetensorError, OSError) as error:
                raise ValueError(
                    f"{self.path(iteration)}: cannot be read ({first_line(error)}): it has the labels of "
                    f"iteration {iteration + 1}; restore it, or train from the beginning in another "
                    "`output_dir`"
                ) from error

    def draw(self, count: int, shown: Callable[[Observation], Observation]) -> dict[str, Any]:
        """Draw a batch of labels at random, as LeRobot's datasets would give them: images in [0, 1].

        `shown` makes frames of the size that the policy sees, where imagined ones are stored smaller.
        """
        parts = [*self.recorded, *self.imagined]
        ends = torch.tensor([len(part) for part in parts]).cumsum(0)
        drawn = torch.randint(int(ends[-1]), (count,))
        part_of = torch.searchsorted(ends, drawn, right=True)
        taken: list[dict[str, Any]] = []
        for index in part_of.unique().tolist():
            part, begin = parts[index], int(ends[index - 1]) if index else 0
            taken.append(shown(part.batch(drawn[part_of == index] - begin)))
        return {
            name: [text for batch in taken for text in batch[name]]
            if name == INSTRUCTIONS
            else torch.cat([batch[name] for batch in taken])
            for name in taken[0]
        }

    def _append(self, tensors: dict[str, Tensor], instructions: list[str]) -> None:
        rows = tensors.pop(ROWS)
        actions = {name: tensors.pop(name) for name in (ACTION, ACTION_IS_PAD) if name in tensors}
        if len(rows):
            self.imagined.append(ExpertLabelBatch(tensors, actions, rows, instructions))


def recorded_successes(
    source: StartFrames, frame_shapes: Mapping[str, tuple[int, int, int]], state_size: int, windows: Windows
) -> list[ExpertLabelBatch]:
    """Return the actions of a dataset's successful episodes as labels; nothing without a dataset or success.

    Args:
        source: the episodes, those of its split, tasks and scenes.
        frame_shapes: camera → shape (3, H, W) of the images that the policy sees, to which recorded ones are
            stretched.
        state_size: components of the state, 0 for observations without it.
        windows: what the policy learns from.
    """
    if not source.given:
        return []
    table, episodes = successes(source)
    if not len(episodes):
        return []
    start, length = (torch.from_numpy(of_all[episodes]) for of_all in (table.start, table.length))
    steps = torch.arange(int(length.max()))[:, None]  # (T, E) below
    acting = steps < length
    taken = torch.from_numpy(table.action[(start + steps.minimum(length - 1)).numpy()])
    actions = action_windows(taken, acting, windows.actions)
    begin = length.cumsum(0) - length  # where the frames of each episode begin below
    episode = torch.arange(len(episodes)).repeat_interleave(length)  # (F,), of each frame
    observations = {
        camera: torch.empty(len(episode), *shape, dtype=torch.uint8) for camera, shape in frame_shapes.items()
    }
    for first, rows, each in zip(begin.tolist(), length.tolist(), episodes.tolist(), strict=True):
        for camera, (_, height, width) in frame_shapes.items():
            frames = decode(table.dataset, each, camera, rows_of(table.dataset, each))
            observations[camera][first : first + rows] = stretch(frames, height, width)
    if state_size:
        rows = (start - begin)[episode] + torch.arange(len(episode))
        observations[OBS_STATE] = torch.from_numpy(table.state[rows.numpy()])
    step, labelled = acting.nonzero(as_tuple=True)
    return [
        ExpertLabelBatch(
            observations | {INSTRUCTIONS: episode},
            actions,
            observed_rows(begin[labelled], step, windows.observations),
            [table.instructions[each] for each in episodes],
        )
    ]


def successes(source: StartFrames) -> tuple[EpisodeTable, np.ndarray]:
    """Return a dataset's episodes, and which of those that `source` names succeed. (E,)"""
    table = read_episodes(source.open())
    episodes = every_chosen_episode(table, source)
    return table, episodes[table.success[episodes]]


def require_memory(frames: int, frame_shapes: Mapping[str, tuple[int, int, int]]) -> None:
    """Raise FieldError if so many frames of `recorded_successes`, of which each process of `torchrun` on this
    machine has its own, do not fit into the free memory."""
    size = local_processes() * frames * sum(map(math.prod, frame_shapes.values()))
    free = psutil.virtual_memory().available
    if size > free:
        raise FieldError(
            "algorithm.recorded",
            True,
            f"the frames of the recorded successes take {size / 1e9:.1f} GB of memory, and "
            f"{free / 1e9:.1f} GB are free",
            "set it to false, or choose fewer episodes (`env.dataset.episodes`)",
        )


def local_processes() -> int:
    """Return how many processes of `torchrun` share this machine's memory."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", 1))


def imagined_labels(
    observations: ObservationBuffer, actions: Tensor, labelled: Tensor, windows: Windows
) -> ExpertLabelBatch:
    """Return the labelled steps of a rollout.

    Args:
        observations: those of the rollout.
        actions: what was done, (T, B, A).
        labelled: (T, B) bool; a run of steps in each environment.
        windows: what the policy learns from.
    """
    step, env = labelled.nonzero(as_tuple=True)
    wanted = observed_rows(env, step, windows.observations, observations.num_envs)
    kept, rows = wanted.unique(return_inverse=True)
    return ExpertLabelBatch(
        observations.read_stored(kept.cpu()),
        action_windows(actions, labelled, windows.actions),
        rows,
        list(observations.instructions),
    )


def observed_rows(first: Tensor, step: Tensor, distances: Sequence[int] | None, stride: int = 1) -> Tensor:
    """Return the rows of the observations that belong to each of the steps (N,): (N, n), or (N,) without
    windows.

    Before an episode begins its first observation is repeated, as LeRobot's datasets do.

    Args:
        first: row of the first observation of each step's episode, (N,).
        step: number of the step in its episode, (N,).
        distances: distances of a window's observations from the step, none above 0; None without windows.
        stride: rows from one step to the next.
    """
    if distances is None:
        return first + step * stride
    steps = (step[:, None] + torch.tensor(distances, device=step.device)).clamp(min=0)
    return first[:, None] + steps * stride


def action_windows(actions: Tensor, labelled: Tensor, distances: Sequence[int] | None) -> dict[str, Tensor]:
    """Return the labels of every labelled step: its action, or those in the window around it.

    What lies before or after the labelled run is marked as padding: the actions that were done before it, the
    first one before the episode began, and the run's last action after its end.

    Args:
        actions: what was done, (T, B, A).
        labelled: (T, B) bool; a run of steps in each environment.
        distances: distances of a window's actions from the step; None without windows.

    Returns:
        `action` (N, A) in the order of `labelled.nonzero()`, or (N, n, A) with `action_is_pad` (N, n).
    """
    step, env = labelled.nonzero(as_tuple=True)
    if distances is None:
        return {ACTION: actions[step, env]}
    first = labelled.long().argmax(0)[env][:, None]
    last = (len(labelled) - 1 - labelled.flip(0).long().argmax(0))[env][:, None]
    wanted = step[:, None] + torch.tensor(distances, device=step.device)  # (N, n)
    outside = (wanted < first) | (wanted > last)
    return {ACTION: actions[wanted.clamp(min=0).minimum(last), env[:, None]], ACTION_IS_PAD: outside}
