"""Observations labelled with actions to imitate, on the CPU and on disk. N labels, n steps of a window."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import decode_episode
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.start_frames import every_chosen_episode
from lerobot_wmrl.rl.observations import TASK, ObservationBuffer, decoded
from lerobot_wmrl.rl.policy_adapters import ACTION_IS_PAD


@dataclass(frozen=True)
class Windows:
    """Which observations and actions around a step a policy learns from, as it tells LeRobot's datasets.

    Args:
        observations: their distances from the step, none later than it (`observation_delta_indices`); None
            for the step's own observation, without an axis of time.
        actions: theirs (`action_delta_indices`), of a chunk for example; None for the step's own.
    """

    observations: list[int] | None = None
    actions: list[int] | None = None

    @classmethod
    def of(cls, policy: PreTrainedConfig) -> "Windows":
        """Return those of a policy."""
        return cls(policy.observation_delta_indices, policy.action_delta_indices)


@dataclass(frozen=True)
class Part:
    """N labels from one place.

    Args:
        tensors: observations with images as bytes, `task` as an index into the instructions, `action`, and
            for windows of actions `action_is_pad`; (N, …) each, windows (N, n, …).
        instructions: instructions of the tasks.
    """

    tensors: dict[str, Tensor]
    instructions: list[str]

    def __len__(self) -> int:
        return len(self.tensors[ACTION])


class Labels:
    """Labels of a dataset, and those of all iterations, one file each, so that a resumed training has them.

    Args:
        folder: folder of the files.
        process: number of this process, which has files of its own.
    """

    def __init__(self, folder: Path, process: int) -> None:
        self.folder, self.process = folder, process
        self.recorded: list[Part] = []
        self.imagined: list[Part] = []

    def __len__(self) -> int:
        return sum(map(len, (*self.recorded, *self.imagined)))

    def path(self, iteration: int) -> Path:
        """Return the file of an iteration."""
        return self.folder / f"{iteration:06d}-{self.process}.safetensors"

    def add(self, iteration: int, part: Part) -> None:
        """Add an iteration's labels, on disk first."""
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = self.path(iteration).with_suffix(".partial")
        tensors = {name: value.cpu().contiguous() for name, value in part.tensors.items()}
        save_file(tensors, partial, {"instructions": json.dumps(part.instructions)})
        partial.replace(self.path(iteration))
        self._append(Part(tensors, part.instructions))

    def load(self, iterations: int) -> None:
        """Read the labels of the iterations before `iterations`, in place of those in memory.

        Raises:
            FileNotFoundError: a file is missing.
        """
        self.imagined = []
        for iteration in range(iterations):
            with safe_open(self.path(iteration), framework="pt") as file:
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                self._append(Part(tensors, json.loads(file.metadata()["instructions"])))

    def draw(self, count: int) -> dict[str, Any]:
        """Draw a batch of labels at random, as LeRobot's datasets would give them: images in [0, 1]."""
        parts = [*self.recorded, *self.imagined]
        ends = torch.tensor([len(part) for part in parts]).cumsum(0)
        drawn = torch.randint(int(ends[-1]), (count,))
        part_of = torch.searchsorted(ends, drawn, right=True)
        taken: list[dict[str, Any]] = []
        for index in part_of.unique().tolist():
            part, begin = parts[index], int(ends[index - 1]) if index else 0
            rows = drawn[part_of == index] - begin
            chosen = {name: value[rows] for name, value in part.tensors.items()}
            taken.append(decoded(chosen, part.instructions))
        return {
            name: [text for batch in taken for text in batch[name]] if name == TASK
            else torch.cat([batch[name] for batch in taken])
            for name in taken[0]
        }  # fmt: skip

    def _append(self, part: Part) -> None:
        if len(part):
            self.imagined.append(part)


def recorded_successes(
    source: StartFrames, cameras: Sequence[str], state_size: int, windows: Windows
) -> list[Part]:
    """Return the actions of a dataset's successful episodes as labels; nothing without a dataset or success.

    Args:
        source: the episodes, those of its split, tasks and scenes.
        cameras: keys of the images.
        state_size: components of the state, 0 for observations without it.
        windows: what the policy learns from.
    """
    if not source.given:
        return []
    table = read_episodes(source.open())
    episodes = every_chosen_episode(table, source)
    episodes = episodes[table.success[episodes]]
    if not len(episodes):
        return []
    start, length = (torch.from_numpy(of_all[episodes]) for of_all in (table.start, table.length))
    steps = torch.arange(int(length.max()))[:, None]  # (T, E) below
    acting = steps < length
    rows = start + steps.minimum(length - 1)
    labels = action_windows(torch.from_numpy(table.action[rows.numpy()]), acting, windows.actions)
    step, episode = acting.nonzero(as_tuple=True)
    seen = observed_steps(step, windows.observations)  # (N,) or (N, n)
    own = episode if seen.ndim == 1 else episode[:, None]
    for camera in cameras:
        frames = [decode_episode(table.dataset, int(each), camera) for each in episodes]
        labels[camera] = torch.cat(frames)[(length.cumsum(0) - length)[own] + seen]
    if state_size:
        labels[OBS_STATE] = torch.from_numpy(table.state[(start[own] + seen).numpy()])
    labels[TASK] = episode
    return [Part(labels, [table.instructions[each] for each in episodes])]


def observed_steps(step: Tensor, distances: Sequence[int] | None) -> Tensor:
    """Return the steps whose observations belong to each of the steps (N,): (N, n), or (N,) without windows.

    Before an episode begins its first observation is repeated, as LeRobot's datasets do.
    """
    if distances is None:
        return step
    return (step[:, None] + torch.tensor(distances, device=step.device)).clamp(min=0)


def observation_windows(
    observations: ObservationBuffer, step: Tensor, env: Tensor, distances: Sequence[int] | None
) -> dict[str, Tensor]:
    """Return the observations, as they are stored, that belong to steps (N,) of environments (N,)."""
    steps = observed_steps(step, distances)
    rows = steps * observations.num_envs + (env if steps.ndim == 1 else env[:, None])
    stored = observations.read_stored(rows.flatten().cpu())
    if distances is None:
        return stored
    windows = {name: value.unflatten(0, rows.shape) for name, value in stored.items()}
    return {name: value if name.startswith(OBS_STR) else value[:, -1] for name, value in windows.items()}


def action_windows(actions: Tensor, labelled: Tensor, distances: Sequence[int] | None) -> dict[str, Tensor]:
    """Return the labels of every labelled step: its action, or those in the window around it.

    A window ends with its labelled run, beyond which the last action is repeated and marked as padding, as is
    the first before the episode.

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
    last = len(labelled) - 1 - labelled.flip(0).long().argmax(0)  # (B,), of the environments with labels
    wanted, end = step[:, None] + torch.tensor(distances, device=step.device), last[env][:, None]
    there = wanted.clamp(min=0).minimum(end)
    return {ACTION: actions[there, env[:, None]], ACTION_IS_PAD: wanted != there}
