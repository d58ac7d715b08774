"""Where imagined episodes may begin: as those of a dataset, in saved frames, in the simulator's resets."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import ACTION_LOW, TASKS
from lerobot_wmrl.data.compatibility import check_dataset
from lerobot_wmrl.data.depth_maps import depth_at
from lerobot_wmrl.data.episode_table import (
    EpisodeTable,
    choose_episodes,
    evenly_spread,
    open_dataset,
    read_episodes,
)
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.maniskill.scenes import scene_for_seed, scenes_of
from lerobot_wmrl.maniskill.tasks import task_of

INSTRUCTION = "task"
"""Name of the instructions in a file of saved frames."""


class FirstFrames(NamedTuple):
    """Where K episodes begin, each after T − 1 frames that are only looked at: images (K, T, N, H, W, 3)
    uint8, state (K, T, P), actions (K, T − 1, A), one instruction each; tasks (K,), indices into `TASKS`, −1
    where unknown; depth of a model's frames, (K, T, S) metres, None if it looks at none."""

    images: np.ndarray
    state: np.ndarray
    actions: np.ndarray
    instructions: list[str]
    tasks: np.ndarray
    depth: Callable[[Any], Tensor | None]

    def of_task(self, task: int) -> "FirstFrames":
        """Those of one task."""
        rows = np.flatnonzero(self.tasks == task)

        def depth(model: Any) -> Tensor | None:
            every = self.depth(model)
            return every if every is None else every[torch.from_numpy(rows).to(every.device)]

        instructions = [self.instructions[row] for row in rows]
        return FirstFrames(
            self.images[rows], self.state[rows], self.actions[rows], instructions, self.tasks[rows], depth
        )


def read_first_frames(source: StartFrames, config: Any) -> FirstFrames:
    """As a world model of this configuration sees them. ValueError if they do not fit it."""
    source.check()
    if source.frames is not None:
        return saved_frames(source.frames, source.max_starts, config)
    return simulated_frames(source, config) if source.resets else dataset_frames(source, config)


def chosen_episodes(table: EpisodeTable, source: StartFrames) -> np.ndarray:
    """Episodes to begin like, of the split, tasks and scenes asked for. (K,) ValueError if there is none."""
    unseen = {scene.index for scene in scenes_of("ood")}
    wanted = np.ones(len(table.start), bool)
    for name, column, values in (
        ("tasks", table.task, [TASKS.index(task) for task in source.tasks or ()]),
        ("scenes", table.scene, source.scenes or ()),
    ):
        if values and not np.isin(column, values).any():
            raise ValueError(
                f"--env.dataset.{name}={getattr(source, name)}: no episode of {source.root} has one of them"
            )
        wanted &= np.isin(column, values) if values else True
    if source.past:
        wanted &= undecided_after(table, source.past)
    return choose_episodes(table, source.split, source.max_starts, unseen, wanted)


def undecided_after(table: EpisodeTable, frames: int) -> np.ndarray:
    """Episodes that last longer than so many frames and have not succeeded by then. (E,)"""
    begun = [table.done[start : start + frames + 1].any() for start in table.start]
    return (table.length > frames) & ~np.array(begun)


def dataset_frames(source: StartFrames, config: Any) -> FirstFrames:
    """Of a LeRobotDataset's episodes."""
    table = read_episodes(open_dataset(source.root, source.repo_id))
    check_dataset(config, table.dataset.features)
    episodes = chosen_episodes(table, source)
    if source.past >= config.memory:
        raise ValueError(
            f"--env.dataset.past={source.past}: the world model remembers {config.memory} frames, so give "
            f"at most {config.memory - 1}"
        )
    rows = table.start[episodes, None] + np.arange(source.past + 1)

    def depth(model: Any) -> Tensor | None:
        check_dataset(model.config, table.dataset.features)
        every = depth_at(model, table.dataset, rows.reshape(-1))
        return every if every is None else every.unflatten(0, rows.shape)

    return FirstFrames(
        cached_frames(table.dataset, config.camera_keys)[rows],
        table.state[rows],
        table.action[rows[:, :-1]],
        [table.instructions[episode] for episode in episodes],
        table.task[episodes],
        depth,
    )


def saved_frames(path: Path, at_most: int, config: Any) -> FirstFrames:
    """Of a file by `numpy.savez`: `observation.images.<camera>` (K, H, W, 3) uint8, `observation.state`
    (K, P) and `task` (K,), the instructions. ValueError if it lacks one, or has it otherwise."""
    found = read_arrays(path)
    shape = (config.image_size, config.image_size, 3)
    wanted = {**dict.fromkeys(config.camera_keys, shape), OBS_STATE: (config.state_size,), INSTRUCTION: ()}
    count = max((len(found[name]) for name in wanted if name in found and found[name].ndim), default=0)
    for name, size in wanted.items():
        if name not in found or not count or found[name].shape != (count, *size):
            has = found[name].shape if name in found else "nothing of that name"
            raise ValueError(
                f"--env.dataset.frames={path}: needs {name} of shape {(count or 'K', *size)}, has {has}"
            )
    images = np.stack([found[name] for name in config.camera_keys], 1)
    if images.dtype != np.uint8:
        raise ValueError(f"--env.dataset.frames={path}: pictures are {images.dtype}, they must be uint8")
    if not np.isfinite(found[OBS_STATE]).all():
        raise ValueError(f"--env.dataset.frames={path}: {OBS_STATE} holds NaN or infinity")
    rows = evenly_spread(count, at_most)
    instructions = [str(text) for text in found[INSTRUCTION][rows]]
    state = found[OBS_STATE][rows].astype(np.float32)
    return _without_past(images[rows], state, instructions, np.full(len(rows), -1))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """What `numpy.savez` wrote. ValueError if it did not."""
    try:
        with np.load(path) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise ValueError(
            f"--env.dataset.frames={path}: cannot be read ({error}); write it with numpy.savez"
        ) from error


def simulated_frames(source: StartFrames, config: Any) -> FirstFrames:
    """Of ManiSkill's resets, seeds 0, 1, …: consecutive ones visit the scenes in turn, then the next task."""
    tasks = source.tasks or TASKS[:1]
    env = WmrlManiSkillEnv(
        task=tasks[0], split="ood" if source.split == "ood" else "ind", scenes=source.scenes,
        cameras=list(config.cameras), image_size=config.image_size,
    )  # fmt: skip
    scenes, simulation = env.selected_scenes(), env.create_simulation()
    frames, instructions, indices = [], [], []
    for seed in range(source.resets):
        simulation.task = task_of(tasks[seed // len(scenes) % len(tasks)])
        frames.append(simulation.reset(scene_for_seed(scenes, seed), seed))
        instructions.append(simulation.instruction)
        indices.append(simulation.task.index)
    simulation.close()
    images = np.stack([np.stack([frame.images[camera] for camera in config.cameras]) for frame in frames])
    state = np.stack([frame.state for frame in frames])
    return _without_past(images, state, instructions, np.array(indices))


def _without_past(
    images: np.ndarray, state: np.ndarray, instructions: list[str], tasks: np.ndarray
) -> FirstFrames:
    """Single frames, (K, …) each, without depth."""
    actions = np.zeros((len(images), 0, len(ACTION_LOW)), np.float32)
    return FirstFrames(images[:, None], state[:, None], actions, instructions, tasks, _no_depth)


def _no_depth(model: Any) -> None:
    """ValueError if the model looks at it."""
    if model.config.depth:
        raise ValueError(
            "--env.dataset: this world model looks at depth, which only a dataset of depth recordings has; "
            "give --env.dataset.root"
        )
