"""Episodes of a LeRobotDataset: all columns but the pictures."""

import logging
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.compute
import pyarrow.dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_STATE
from numpy.typing import ArrayLike

from lerobot_wmrl.common.constants import START_TASK
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.common.lerobot_commands import edit_advice
from lerobot_wmrl.common.statistics import evenly_spaced

EPISODES_A_TASK: Final = 5
"""Episodes that an instruction has on average where each is a task of its own."""

VALIDATION_EVERY: Final = 20
"""Every twentieth episode is held out from the training of tokenizers and world models."""

SOLVED_FRAMES: Final = 2
"""Last frames of an episode that are taken for solved if it, as most of its dataset, ends as soon as it
succeeds. The picture after the last action, which shows it, is not recorded."""

SUCCESS: Final = "next.success"

SUCCESS_COLUMNS: Final = (SUCCESS, DONE)
"""Columns that can hold success, best first: `next.done` may mark the mere end of an episode."""

PLACE: Final = ("episode_index", "task_index")
"""LeRobot's columns that say which episode and task a frame belongs to."""

OWN_COLUMNS: Final = ("index", "episode_index", "frame_index", "task_index")
"""LeRobot's integer columns, which say nothing about an episode."""


def success_column(columns: Container[str]) -> str | None:
    """Return the column that says whether success holds, None if there is none."""
    return next((name for name in SUCCESS_COLUMNS if name in columns), None)


@dataclass
class EpisodeTable:
    """Columns of a dataset without its pictures: N rows (frames) in E episodes.

    Args:
        dataset: the dataset that was read.
        state: (N, P), P = 0 where the dataset has none.
        action: (N, A).
        done: (N,), whether success holds after the frame's action; False where the dataset does not say.
        start: (E,), row of each episode's first frame.
        length: (E,), frames of each episode.
        instructions: one an episode, that of its first frame.
        columns: the dataset's further integer columns by name, (E,): their values at the first frames.
        inferred_success: what stands for `done` in training, (N,), where no frame shows success.
    """

    dataset: LeRobotDataset
    state: np.ndarray
    action: np.ndarray
    done: np.ndarray
    start: np.ndarray
    length: np.ndarray
    instructions: list[str]
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    inferred_success: np.ndarray | None = None

    @property
    def success_target(self) -> np.ndarray:
        """What models learn as success: `done`, or what stands for it. (N,)"""
        return self.done if self.inferred_success is None else self.inferred_success

    def column(self, name: str) -> np.ndarray:
        """Return an integer column's values, −1 where the dataset has no such column. (E,)"""
        return self.columns.get(name, np.full(len(self.start), -1))

    @property
    def shown(self) -> np.ndarray:
        """Whether a row's frame shows success, which holds after the action before it. (N,)"""
        shown = np.append(False, self.success_target[:-1])
        shown[self.start] = False  # an episode's first frame follows no action
        return shown

    def shows_success(self, episodes: Iterable[int]) -> bool:
        """Return whether any frame of the episodes shows success."""
        shown = self.shown
        return any(shown[rows].any() for rows in self.rows(episodes))

    @property
    def has_labels(self) -> bool:
        """Whether the dataset says where success holds; else done is False everywhere."""
        return success_column(self.dataset.features) is not None

    @property
    def success(self) -> np.ndarray:
        """Whether success was ever reached. (E,)"""
        return np.array([self.done[rows].any() for rows in self.rows(range(len(self.start)))])

    @property
    def validation(self) -> np.ndarray:
        """Held-out episodes. (E,)"""
        return np.arange(len(self.start)) % VALIDATION_EVERY == VALIDATION_EVERY - 1

    def rows(self, episodes: Iterable[int]) -> list[slice]:
        """Return where each of the episodes has its frames."""
        return [slice(self.start[each], self.start[each] + self.length[each]) for each in episodes]

    def row_numbers(self, episodes: Iterable[int]) -> np.ndarray:
        """Return the rows of all these episodes. (K,)"""
        return np.concatenate([np.arange(rows.start, rows.stop) for rows in self.rows(episodes)])

    def subset(self, episodes: np.ndarray) -> "EpisodeTable":
        """Return some of the episodes, a mask (E,) or indices; `validation` means nothing in the result."""
        columns = {name: values[episodes] for name, values in self.columns.items()}
        return replace(
            self,
            start=self.start[episodes],
            length=self.length[episodes],
            columns=columns,
            instructions=np.array(self.instructions, object)[episodes].tolist(),
        )

    def among(self, chosen: Sequence[int] | None) -> np.ndarray:
        """Mark the episodes that are `chosen`, all if None. (E,)

        Raises:
            FieldError: none is chosen, or one that does not exist.
        """
        indices = np.arange(len(self.start))
        if chosen is not None:
            require_chosen(chosen, len(indices), self.dataset.root)
        return indices >= 0 if chosen is None else np.isin(indices, chosen)

    def training(self, chosen: Sequence[int] | None) -> np.ndarray:
        """Mark the episodes that models learn from: the `chosen` ones, all if None, that are not held out.
        FieldError names one that does not exist. (E,)"""
        marked: np.ndarray = self.among(chosen) & ~self.validation
        return marked


def require_chosen(episodes: Collection[int], total: int, root: Path) -> None:
    """Raise FieldError about `dataset.episodes` if it chooses no episode, or one that does not exist."""
    if not episodes:
        raise FieldError("dataset.episodes", [], "chooses no episode", "leave it out for all")
    require_episodes("dataset.episodes", episodes, total, root)


def require_episodes(name: str, chosen: Collection[int], total: int, root: Path) -> None:
    """Raise FieldError about the setting `name` unless a dataset of `total` episodes has those `chosen`."""
    for episode in chosen:
        if not 0 <= episode < total:
            raise FieldError(
                name,
                chosen if isinstance(chosen, dict) else list(chosen),
                f"there is no episode {episode} in {root}",
                f"it has episodes 0 to {total - 1}",
            )


def count_tasks(tables: Sequence[EpisodeTable]) -> int:
    """Return how many tasks the episodes of several datasets are of.

    The column `start.task` says so where all have it. Else each instruction is a task, if it has
    `EPISODES_A_TASK` episodes on average; if not, they are other words of the same one.
    """
    tasks = np.concatenate([table.column(START_TASK) for table in tables])
    if (tasks >= 0).all():
        return len(np.unique(tasks))
    instructions = {text for table in tables for text in table.instructions}
    return len(instructions) if len(tasks) >= EPISODES_A_TASK * len(instructions) else 1


def read_episodes(dataset: LeRobotDataset) -> EpisodeTable:
    """Read the columns that models train on. FieldError names a missing one, or one with NaN or infinity."""
    require_vectors(dataset)
    success = success_column(dataset.features)
    labels = () if success is None else (success,)
    measured = [name for name in (ACTION, OBS_STATE, *labels) if name in dataset.features]
    further = episode_columns(dataset.features)
    for column in measured:
        check_whole(dataset, column)
    rows = dataset.hf_dataset.with_format("numpy", columns=[*PLACE, *measured, *further])[:]
    for column in measured:
        finite = np.isfinite(as_columns(rows[column])).all(1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise bad_row(dataset, column, row, np.asarray(rows[column][row]).tolist())
    frames = len(rows["episode_index"])
    done = np.zeros(frames, bool) if success is None else truth_of(dataset, success, rows[success])
    _, start, length = np.unique(rows["episode_index"], return_index=True, return_counts=True)
    inferred, ending = None, end_at_success(done, start, length)
    # next.done may say no more than that episodes end
    if success != DONE and 2 * ending.sum() > np.logical_or.reduceat(done, start).sum():
        logging.warning(
            "%s: most episodes end as soon as they succeed, so that no frame shows success. The last %d "
            "frames of those that do are taken for solved; record a few more, if you can",
            dataset.root,
            SOLVED_FRAMES,
        )
        inferred = solved_at_end(done, start[ending], length[ending])
    return EpisodeTable(
        dataset=dataset,
        state=as_columns(rows[OBS_STATE]) if OBS_STATE in rows else np.zeros((frames, 0), np.float32),
        action=as_columns(rows[ACTION]),
        done=done,
        start=start,
        length=length,
        instructions=first_instructions(dataset, np.asarray(rows["task_index"]), start),
        columns={name: np.asarray(rows[name]).reshape(-1)[start] for name in further},
        inferred_success=inferred,
    )


def require_vectors(dataset: LeRobotDataset) -> None:
    """Raise FieldError unless a dataset has actions, and these and its states, if any, are vectors."""
    if ACTION not in dataset.features:
        raise FieldError(
            "dataset.root",
            dataset.root,
            f"the feature {ACTION!r} is missing (it has {', '.join(dataset.features)})",
            "world models need what was done beside what was seen",
        )
    for name in (ACTION, OBS_STATE):
        if len(shape := dataset.features.get(name, {"shape": (1,)})["shape"]) != 1:
            raise FieldError(
                "dataset.root",
                dataset.root,
                f"{name} has the shape {tuple(shape)}, which is no vector",
                "store it as one, as LeRobot's policies read it",
            )


def end_at_success(done: np.ndarray, start: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return which of E episodes succeed with their last action, done (N,): the picture after it is not
    recorded. (E,)"""
    return done[start + length - 1] & (np.add.reduceat(done, start) == 1)


def solved_at_end(done: np.ndarray, start: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Mark, in episodes that end at success, the last action and those before the last `SOLVED_FRAMES`
    frames too. (N,)"""
    solved = done.copy()
    for first, after in zip(start, start + length, strict=True):
        solved[max(first, after - 1 - SOLVED_FRAMES) : after] = True
    return solved


def first_instructions(dataset: LeRobotDataset, task: np.ndarray, start: np.ndarray) -> list[str]:
    """Return the instruction of each episode's first frame; warn of episodes in which it changes.

    Args:
        task: index of each row's task (N,).
        start: first row of each episode (E,).
    """
    ends = np.maximum.reduceat(task, start), np.minimum.reduceat(task, start)
    if several := int((ends[0] != ends[1]).sum()):
        logging.warning(
            "%s: the instruction changes within %d of %d episodes; that of the first frame is taken for the "
            "whole episode",
            dataset.root,
            several,
            len(start),
        )
    texts = {int(index): str(text) for text, index in dataset.meta.tasks["task_index"].items()}
    return [texts[index] for index in task[start].tolist()]


def episode_columns(features: Mapping[str, Any]) -> list[str]:
    """Return the integer columns of one component that a recorder has added to LeRobot's own."""
    return [
        name
        for name, feature in features.items()
        if feature["dtype"] == "int64" and tuple(feature["shape"]) == (1,) and name not in OWN_COLUMNS
    ]


def as_columns(values: ArrayLike) -> np.ndarray:
    """Return N rows as float32 (N, K); LeRobot stores vectors of one component as scalars, (N,)."""
    columns = np.asarray(values, np.float32)
    return columns.reshape(len(columns), -1)


def check_whole(dataset: LeRobotDataset, column: str) -> None:
    """Raise FieldError with the first episode and frame at which a column has no value."""
    rows = dataset.hf_dataset.select_columns([column]).with_format("arrow")[:][column]
    if rows.null_count:
        raise bad_row(dataset, column, rows.is_null().index(True).as_py(), "missing")


def truth_of(dataset: LeRobotDataset, column: str, values: ArrayLike) -> np.ndarray:
    """Return a column of truth values, (N,). FieldError unless they are 0 and 1, or False and True."""
    values = np.asarray(values).reshape(-1)
    other = ~np.isin(values, (0, 1))
    if other.any():
        row = int(np.argmax(other))
        raise bad_row(
            dataset,
            column,
            row,
            f"{values[row]}, neither true nor false",
            "take numbers from a threshold on for true: lerobot-wmrl-label "
            f"{flag_as_typed('dataset.root', dataset.root)} --success.type=column "
            f"--success.column={column} --success.threshold=…",
        )
    return values.astype(bool)


def bad_row(
    dataset: LeRobotDataset, column: str, row: int, value: object, remedy: str | None = None
) -> FieldError:
    """Return the error for a row of a column, N rows in all, whose `value` cannot be learnt from.

    Args:
        remedy: what to do about it; None: remove the episode.
    """
    episodes = dataset.hf_dataset.with_format("numpy", columns=["episode_index"])[:]["episode_index"]
    episode = int(episodes[row])
    frame = row - int(np.argmax(np.asarray(episodes) == episode))
    return FieldError(
        "dataset.root",
        dataset.root,
        f"{column} of episode {episode}, frame {frame}, is {value}",
        remedy
        or "remove the episode: "
        + edit_advice(dataset.root, "delete_episodes", {"operation.episode_indices": [episode]}),
    )


def parquet_files(root: Path) -> list[Path]:
    """Return the files that hold a dataset's rows, in order."""
    return sorted((root / "data").glob("*/*.parquet"))


def read_vectors(root: Path, name: str, episodes: Sequence[int] | None = None) -> np.ndarray:
    """Read a column of numbers, such as the actions, of a dataset on disk, or what some episodes have of it.
    (rows, A) float64"""
    chosen = None
    if episodes is not None:
        chosen = pyarrow.compute.field("episode_index").isin(pyarrow.array(episodes, pyarrow.int64()))
    rows = pyarrow.dataset.dataset(parquet_files(root), format="parquet")
    table = rows.to_table(columns=[name], filter=chosen)
    column = table[name]
    values = pyarrow.compute.list_flatten(column) if pyarrow.types.is_nested(column.type) else column
    return values.to_numpy().astype(np.float64).reshape(table.num_rows, -1)


def choose_episodes(
    table: EpisodeTable,
    split: str,
    at_most: int,
    further: Mapping[str, np.ndarray] | None = None,
    wanted: np.ndarray | None = None,
) -> np.ndarray:
    """Choose at most `at_most` episodes, evenly spread, that belong to every split named in `split`.

    Args:
        table: the episodes.
        split: names joined by commas: `train`, `validation` (as in the training of world models), `all`, or
            one of `further`.
        at_most: how many.
        further: further splits by name, each a mask (E,).
        wanted: a mask (E,) of the episodes to choose from; by default all.

    Returns:
        Indices of the episodes. (K,)

    Raises:
        FieldError: there is no such split, or no episode in it.
    """
    masks = {"train": ~table.validation, "validation": table.validation, "all": table.length > 0}
    masks |= further or {}
    names = split.split(",")
    for name in names:
        if name not in masks:
            raise FieldError("split", split, f"choose one of {', '.join(masks)}, or several joined by commas")
    chosen = [masks[name] for name in names] + ([] if wanted is None else [wanted])
    episodes = np.logical_and.reduce(chosen).nonzero()[0]
    if not len(episodes):
        those = "" if wanted is None else " of those that are asked for"
        raise FieldError("split", split, f"dataset {table.dataset.root} has no episode{those} in it")
    return episodes[evenly_spaced(len(episodes), at_most)]
