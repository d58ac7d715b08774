"""Frames at which imagined episodes begin, from a dataset's episodes, a file or ManiSkill's resets.

A world model tokenises them then (`starts`). K is the number of starts, N the number of cameras.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import INSTRUCTIONS, START_SCENE, START_SEED, START_TASK, TASK_NAMES
from lerobot_wmrl.common.errors import FieldError, renamed, within
from lerobot_wmrl.common.images import stretch, to_pixels
from lerobot_wmrl.common.statistics import evenly_spaced
from lerobot_wmrl.data.episodes import EpisodeTable, choose_episodes, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.data.ledger import Ledger
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.maniskill.recordings import require_unreported, scene_splits
from lerobot_wmrl.maniskill.scenes import scene_for_seed
from lerobot_wmrl.maniskill.tasks import task_of
from lerobot_wmrl.world_models.checkpoint import check_dataset
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import WorldModelConfig
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.modeling_world_model import WorldModelRewardModel

GOLDEN_RATIO = (5**0.5 - 1) / 2
"""Its multiples, modulo 1, are spread over the unit interval, any of them in a row."""

ORIGINS = START_TASK, START_SCENE, START_SEED
"""Columns that say how a recorded episode began."""


class StartImages(NamedTuple):
    """The frames in which K imagined episodes begin.

    images (K, N, H, W, 3) uint8; first_images, of the same shape: the first frame of the recorded episode
    that each is taken from; state (K, P); K instructions; origins, what is known of how these episodes began,
    by the columns `start.task`, `start.scene` and `start.seed`, (K,) each; depth, a function of a world model
    that returns (K, S) in metres, or None if the model does not look at depth.
    """

    images: np.ndarray
    first_images: np.ndarray
    state: np.ndarray
    instructions: list[str]
    origins: Mapping[str, np.ndarray]
    depth: Callable[[WorldModelRewardModel], Tensor | None]

    @property
    def tasks(self) -> np.ndarray:
        """The task of each start, an index into `TASK_NAMES`, −1 where unknown. (K,)"""
        return self.origins.get(START_TASK, np.full(len(self.images), -1))

    def of_task(self, task: int) -> "StartImages":
        """Return the starts of one task, an index into `TASK_NAMES`."""
        return self.chosen(np.flatnonzero(self.tasks == task))

    def chosen(self, rows: np.ndarray) -> "StartImages":
        """Return some of the starts, by their indices."""

        def depth(model: WorldModelRewardModel) -> Tensor | None:
            every = self.depth(model)
            return every if every is None else every[torch.from_numpy(rows).to(every.device)]

        instructions = [self.instructions[row] for row in rows]
        return StartImages(
            images=self.images[rows],
            first_images=self.first_images[rows],
            state=self.state[rows],
            instructions=instructions,
            origins={name: values[rows] for name, values in self.origins.items()},
            depth=depth,
        )


def read_start_images(source: StartFrames, config: WorldModelConfig) -> StartImages:
    """Read the frames that a world model of this configuration can begin in.

    Raises:
        ValueError: `source` asks for frames that are not there or do not fit the world model.
    """
    source.validate()
    if source.frames is not None:
        return read_saved_frames(source.frames, source.max_starts, config)
    if source.resets:
        return simulate_first_frames(source, config)
    return read_dataset_frames(source, config)


def chosen_episodes(table: EpisodeTable, source: StartFrames) -> np.ndarray:
    """Return the episodes of the split, tasks and scenes that `source` names. (K,)

    Raises:
        ValueError: there is no such episode.
    """
    wanted, scene = table.among(source.episodes), table.column(START_SCENE)
    for name, column, values in (
        ("tasks", table.column(START_TASK), [TASK_NAMES.index(task) for task in source.tasks or ()]),
        ("scenes", scene, source.scenes or ()),
    ):
        if values and not np.isin(column, values).any():
            raise FieldError(
                f"dataset.{name}", getattr(source, name), f"no episode of {source.name} has one of them"
            )
        wanted &= np.isin(column, values) if values else True
    episodes = max(1, source.max_starts // (1 + source.branches))
    with renamed("split", "dataset.split"):
        return choose_episodes(table, source.split, episodes, scene_splits(scene, source.split), wanted)


def every_chosen_episode(table: EpisodeTable, source: StartFrames) -> np.ndarray:
    """Return the same episodes without a limit to their number. (K,)"""
    return chosen_episodes(table, replace(source, max_starts=len(table.start), branches=0))


def check_starts(source: StartFrames, ledger: Ledger | None) -> None:
    """Raise FieldError for starts from which nothing may be learnt.

    These are starts that results are reported on, and, if there is a ledger, starts that are not in it.
    Every episode of the split, tasks and scenes is looked at: distillation learns from all that succeed.
    """
    if ledger is not None and not source.given:
        kind = "frames" if source.frames else "resets"
        raise FieldError(
            f"dataset.{kind}",
            getattr(source, kind),
            "under a budget, episodes start in recorded ones",
            "give `dataset.root`",
        )
    if source.resets and source.split == "ood":
        raise FieldError(
            "dataset.split",
            "ood",
            "results are reported on unseen scenes: nothing may be learnt in them",
            "choose ind",
        )
    if not source.given:
        return
    table = read_episodes(source.open())
    episodes = every_chosen_episode(table, source)
    require_unreported(table, episodes, "choose others with `dataset.split=ind` or `dataset.scenes`")
    if ledger is not None:
        ledger.require_known(table, episodes)


def undecided_frames(table: EpisodeTable, episodes: np.ndarray) -> np.ndarray:
    """Return the number of frames before the first success of K episodes, all if there is none. (K,)"""
    done = table.success_target
    start, solved = table.start[episodes], np.append(np.flatnonzero(done), len(done))
    return np.minimum(solved[np.searchsorted(solved, start)] - start, table.length[episodes])


def branch_frames(table: EpisodeTable, episodes: np.ndarray, branches: int) -> np.ndarray:
    """Return the rows of each episode's first frame and `branches` later ones. (K,), without repetitions

    They are spread evenly over the frames before its success, and before its last frame, and follow the first
    frame: any starts in a row are as many first frames as others. With branches the episodes are in an order
    in which any in a row are spread over all of them (a golden-ratio sequence).
    """
    if branches:
        episodes = episodes[np.argsort(np.arange(len(episodes)) * GOLDEN_RATIO % 1)]
    last = np.minimum(undecided_frames(table, episodes), table.length[episodes] - 1)
    offsets = np.maximum(last, 1)[:, None] * np.arange(1 + branches) // (1 + branches)
    rows = (table.start[episodes, None] + offsets).flatten()
    _, first = np.unique(rows, return_index=True)
    return rows[np.sort(first)]


def read_dataset_frames(source: StartFrames, config: WorldModelConfig) -> StartImages:
    """Read frames of a LeRobotDataset's episodes: the first ones, and those of the branches."""
    tokenizer_config = config.trained_tokenizer
    table = read_episodes(source.open())
    check_dataset(config, table.dataset.meta)
    if source.branches and not tokenizer_config.context:
        raise FieldError(
            "dataset.branches",
            source.branches,
            "the world model is not shown how an episode began, so it cannot tell success from its middle on",
            "train its tokenizer with `model.tokenizer.context=true`, or leave `branches` out",
        )
    return recorded_frames(
        table, branch_frames(table, chosen_episodes(table, source), source.branches), tokenizer_config
    )


def recorded_frames(table: EpisodeTable, rows: np.ndarray, tokenizer_config: TokenizerConfig) -> StartImages:
    """Read these rows (K,) of a dataset as this tokenizer sees them."""
    episodes = np.searchsorted(table.start, rows, side="right") - 1
    images = cached_frames(table.dataset, tokenizer_config.camera_keys, tokenizer_config.image_size)

    def depth(model: WorldModelRewardModel) -> Tensor | None:
        check_dataset(model.config, table.dataset.meta)
        return model.recorded_depth(table.dataset, rows)

    return StartImages(
        images=images[rows],
        first_images=images[table.start[episodes]],
        state=table.state[rows],
        instructions=[table.instructions[episode] for episode in episodes],
        origins={name: table.columns[name][episodes] for name in ORIGINS if name in table.columns},
        depth=depth,
    )


def observed_frame(observation: Mapping[str, Any], tokenizer_config: TokenizerConfig) -> StartImages:
    """Take what an environment shows, in LeRobot's names and batches of one, as the start of an episode.

    Raises:
        ValueError: it lacks a camera of the tokenizer.
    """
    tensors = {name: value.cpu() for name, value in observation.items() if isinstance(value, Tensor)}
    images = to_pixels(stack_cameras(tensors, tokenizer_config.camera_keys, tokenizer_config.image_size))
    state = tensors.get(OBS_STATE, torch.zeros(len(images), 0)).float().numpy()
    return StartImages(images, images, state, list(observation["task"]), {}, without_depth)


def read_saved_frames(path: Path, max_starts: int, config: WorldModelConfig) -> StartImages:
    """Read first frames from a file written by `numpy.savez`.

    Args:
        path: a file with `observation.images.<camera>` (K, H, W, 3) uint8, `task` (K,), the instructions, and
            `observation.state` (K, P), unless the world model has none.
        max_starts: number of frames to keep at most, spread evenly.
        config: configuration of the world model.

    Raises:
        FieldError: the file lacks one of these, or has it in another shape.
    """
    arrays = read_arrays(path)
    side, shapes = config.trained_tokenizer.image_size, config.trained_tokenizer.frame_shapes
    images = {key: (height, width, 3) for key, (_, height, width) in shapes.items()}
    states = {OBS_STATE: (config.state_size,)} if config.state_size else {}
    wanted = {**images, **states, INSTRUCTIONS: ()}
    count = max((len(arrays[name]) for name in wanted if name in arrays and arrays[name].ndim), default=0)
    for name, size in wanted.items():
        if name not in arrays or not count or arrays[name].shape != (count, *size):
            has = arrays[name].shape if name in arrays else "nothing of that name"
            raise FieldError(
                "dataset.frames", path, f"needs {name} of shape {(count or 'K', *size)}, has {has}"
            )
    for name in shapes:
        if arrays[name].dtype != np.uint8:
            raise FieldError("dataset.frames", path, f"{name} is {arrays[name].dtype}, it must be uint8")
    if arrays[INSTRUCTIONS].dtype.kind != "U":
        raise FieldError(
            "dataset.frames",
            path,
            f"{INSTRUCTIONS} is {arrays[INSTRUCTIONS].dtype}, it must be text",
            "save an array of str",
        )
    rows = evenly_spaced(count, max_starts)
    state = arrays[OBS_STATE][rows].astype(np.float32) if states else np.zeros((len(rows), 0), np.float32)
    if not np.isfinite(state).all():
        raise FieldError("dataset.frames", path, f"{OBS_STATE} contains NaN or infinity")
    instructions = [str(text) for text in arrays[INSTRUCTIONS][rows]]
    squares = np.stack([_squares(arrays[name][rows], side) for name in shapes], 1)
    return StartImages(squares, squares, state, instructions, {}, without_depth)


def _squares(images: np.ndarray, side: int) -> np.ndarray:
    """Stretch images uint8 (K, H, W, 3) → (K, side, side, 3)."""
    return stretch(torch.from_numpy(images).permute(0, 3, 1, 2), side, side).permute(0, 2, 3, 1).numpy()


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a file written by `numpy.savez`. FieldError if it is none."""
    try:
        with np.load(path) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise FieldError(
            "dataset.frames", path, f"cannot be read ({error})", "write it with numpy.savez"
        ) from error


def simulate_first_frames(source: StartFrames, config: WorldModelConfig) -> StartImages:
    """Render the first frames of ManiSkill's resets with seeds 0, 1, …

    Consecutive seeds visit the scenes in turn, then the next task.

    Raises:
        FieldError: the dataset's frames, which they have to be like, are no squares of one size.
    """
    tasks, tokenizer_config = source.tasks or TASK_NAMES[:1], config.trained_tokenizer
    remedy = "start in the dataset's episodes (`dataset.root`)"
    side = maniskill_side(tokenizer_config, "dataset.resets", source.resets, remedy)
    env = WmrlManiSkillEnv(
        task=tasks[0],
        split="ood" if source.split == "ood" else "ind",
        scenes=source.scenes,
        cameras=list(tokenizer_config.cameras),
        image_size=side,
    )
    with within("dataset"):
        scenes = env.selected_scenes()
    simulation = env.create_simulation()
    frames, instructions, begun = [], [], []
    for seed in range(source.resets):
        simulation.task = task_of(tasks[seed // len(scenes) % len(tasks)])
        scene = scene_for_seed(scenes, seed)
        frames.append(simulation.reset(scene, seed))
        instructions.append(simulation.instruction)
        begun.append((simulation.task.index, scene.index, seed))
    simulation.close()
    views = ([frame.images[camera] for frame in frames] for camera in tokenizer_config.cameras)
    images = np.stack([_squares(np.stack(view), tokenizer_config.image_size) for view in views], 1)
    state = np.stack([frame.state for frame in frames])
    origins = dict(zip(ORIGINS, np.array(begun).T, strict=True))
    return StartImages(images, images, state, instructions, origins, without_depth)


def maniskill_side(tokenizer_config: TokenizerConfig, field: str, value: object, remedy: str) -> int:
    """Return the side of the frames that ManiSkill renders, that of the dataset's.

    Raises:
        FieldError: about this field and value, with this remedy; the dataset's are no squares of one size.
    """
    if tokenizer_config.square_side is None:
        raise FieldError(
            field,
            value,
            "ManiSkill's frames are squares of one size, those that the world model has learnt from are not",
            remedy,
        )
    return tokenizer_config.square_side


def without_depth(model: WorldModelRewardModel) -> None:
    """Raise FieldError if the model looks at depth."""
    if model.config.depth:
        raise FieldError(
            "dataset.root",
            None,
            "this world model looks at depth, which saved frames and resets lack",
            "give a dataset that was recorded with depth",
        )
