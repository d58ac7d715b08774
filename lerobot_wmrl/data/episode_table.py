"""A LeRobotDataset's numbers, without its pictures: what training and evaluation index episodes by."""

from collections.abc import Collection, Container, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_STATE
from numpy.typing import ArrayLike

from lerobot_wmrl.common.constants import KINDS

VIDEO_BACKEND = "pyav"
"""Ships its own FFmpeg; torchcodec needs the system's, and frames are decoded only once anyway."""

VALIDATION_EVERY = 20
"""Every twentieth episode is held out from the training of tokenizers and world models."""

SUCCESS_COLUMNS = ("next.success", DONE)
"""Where success is looked for. Beside the first, LeRobot's `next.done` may be the mere end of an episode."""


def success_column(columns: Container[str]) -> str | None:
    """The one of a dataset that says whether success holds; None if it does not say."""
    return next((name for name in SUCCESS_COLUMNS if name in columns), None)


@dataclass
class EpisodeTable:
    """Per frame (N rows): state (N, P), action (N, A), done (N,): success. Per episode (E): start, length, ….

    `kind` and `task` hold indices into `constants.KINDS` and `TASKS`, `scene` those of the recorded scenes,
    −1 where the dataset does not say.
    """

    dataset: LeRobotDataset
    state: np.ndarray
    action: np.ndarray
    done: np.ndarray
    start: np.ndarray
    length: np.ndarray
    kind: np.ndarray
    scene: np.ndarray
    task: np.ndarray
    instructions: list[str]

    @property
    def done_known(self) -> bool:
        """Whether the dataset says where success holds; else done is False everywhere."""
        return success_column(self.dataset.features) is not None

    @property
    def success(self) -> np.ndarray:
        """Whether success was ever reached. (E,)"""
        return np.array([self.done[a : a + n].any() for a, n in zip(self.start, self.length, strict=True)])

    @property
    def validation(self) -> np.ndarray:
        """Held-out episodes. (E,)"""
        return np.arange(len(self.start)) % VALIDATION_EVERY == VALIDATION_EVERY - 1

    def among(self, chosen: Sequence[int] | None) -> np.ndarray:
        """Which episodes are `chosen`, all if None. ValueError names one that does not exist. (E,)"""
        indices = np.arange(len(self.start))
        for episode in chosen or ():
            if not 0 <= episode < len(indices):
                raise ValueError(
                    f"--dataset.episodes: there is no episode {episode} in {self.dataset.root}; it has "
                    f"episodes 0 to {len(indices) - 1}"
                )
        return indices >= 0 if chosen is None else np.isin(indices, chosen)


def open_dataset(root: str | Path, repo_id: str | None = None) -> LeRobotDataset:
    """Open a local LeRobotDataset. ValueError if there is none at `root`, or it is not whole."""
    if not (Path(root) / "meta" / "info.json").is_file():
        raise ValueError(
            f"dataset.root={root}: no LeRobotDataset there (meta/info.json is missing); record one first"
        )
    name = repo_id or Path(root).name
    try:
        missing = missing_files(LeRobotDatasetMetadata(name, root=root))
        if not missing:
            return LeRobotDataset(name, root=root, video_backend=VIDEO_BACKEND)
    except Exception as error:  # parquet, JSON, datasets and the hub each raise their own
        raise ValueError(
            f"dataset.root={root}: cannot be opened ({str(error).strip().splitlines()[0]}); it is corrupted: "
            "remove it and record it again"
        ) from error
    raise ValueError(
        f"dataset.root={root}: {len(missing)} files are missing, the first is {missing[0]}; copy the dataset "
        "again, or remove it and record it again"
    )


def missing_files(meta: LeRobotDatasetMetadata) -> list[Path]:
    """Files that the metadata names and that are not there; LeRobot would ask the hub for them."""
    named = set()
    for episode in range(meta.total_episodes):
        named.add(meta.get_data_file_path(episode))
        named.update(meta.get_video_file_path(episode, key) for key in meta.video_keys)
    return sorted(path for path in named if not (Path(meta.root) / path).is_file())


def read_episodes(dataset: LeRobotDataset) -> EpisodeTable:
    """Read the columns that models train on. ValueError names a missing one, or one with NaN or infinity."""
    if ACTION not in dataset.features:
        raise ValueError(
            f"dataset.root={dataset.root}: the feature {ACTION!r} is missing (it has "
            f"{', '.join(dataset.features)}); world models need what was done beside what was seen"
        )
    columns = [ACTION, "episode_index"]
    success = success_column(dataset.features)
    labels = [] if success is None else [success]
    optional = (OBS_STATE, *labels, "start.kind", "start.scene", "start.task")
    columns += [name for name in optional if name in dataset.features]
    rows = dataset.hf_dataset.with_format("numpy", columns=columns)[:]
    for column in (ACTION, OBS_STATE, *labels):
        if column in rows:
            check_finite(dataset, column, np.asarray(rows[column]), rows["episode_index"])
    frames = len(rows["episode_index"])
    _, start, length = np.unique(rows["episode_index"], return_index=True, return_counts=True)
    kind, scene, task = (
        np.asarray(rows[name]).reshape(-1)[start] if name in rows else np.full(len(start), -1)
        for name in ("start.kind", "start.scene", "start.task")
    )
    done = np.asarray(rows[success]).reshape(-1) if success else np.zeros(frames, bool)
    state = np.zeros((frames, 0), np.float32)
    if OBS_STATE in rows:
        state = as_columns(rows[OBS_STATE])
    instructions = [episode["tasks"][0] for episode in dataset.meta.episodes]
    action = as_columns(rows[ACTION])
    return EpisodeTable(
        dataset, state, action, done.astype(bool), start, length, kind, scene, task, instructions
    )


def as_columns(values: ArrayLike) -> np.ndarray:
    """Float32 (N, K) of N rows; LeRobot stores vectors of one component as scalars, (N,)."""
    columns = np.asarray(values, np.float32)
    return columns.reshape(len(columns), -1)


def check_finite(dataset: LeRobotDataset, column: str, values: np.ndarray, episode: np.ndarray) -> None:
    """ValueError names the first episode and frame at which values (N, …) hold NaN or infinity."""
    finite = np.isfinite(values.astype(np.float64).reshape(len(values), -1)).all(1)
    if not finite.all():
        row = int(np.argmin(finite))
        frame = row - int(np.argmax(episode == episode[row]))
        raise ValueError(
            f"dataset.root={dataset.root}: {column} of episode {episode[row]}, frame {frame}, is "
            f"{values[row].tolist()}; remove the episode with lerobot-edit-dataset "
            f"--operation.type=delete_episodes --operation.episode_indices=[{episode[row]}]"
        )


def golden_episodes(table: EpisodeTable) -> np.ndarray:
    """Successful optimal episodes, from which the text world model learns. (E,) bool."""
    optimal = (table.kind == KINDS.index("optimal")) | (table.kind == -1)
    return table.success & optimal


def choose_episodes(
    table: EpisodeTable, split: str, at_most: int, unseen: Collection[int] | None = None,
    wanted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Indices of at most `at_most` episodes, evenly spread, that belong to every split named in `split`.

    Splits, joined by commas: `train`, `validation` (as in the training of world models), `all`, and if the
    scenes `unseen` in training are given, `ind` (all others) and `ood` (those). `wanted` (E,) leaves others
    out. ValueError if there is none.
    """
    masks = {"train": ~table.validation, "validation": table.validation, "all": table.length > 0}
    if unseen is not None:
        known, out = table.scene >= 0, np.isin(table.scene, list(unseen))
        masks |= {"ind": known & ~out, "ood": known & out}
    names = split.split(",")
    for name in names:
        if name not in masks:
            raise ValueError(f"split={name!r}: choose one of {', '.join(masks)}, or several joined by commas")
        if name in ("ind", "ood") and (table.scene < 0).all():
            raise ValueError(
                f"split={name!r}: dataset {table.dataset.root} does not say which scenes its episodes are in "
                "(no column start.scene); use --split=all, train or validation"
            )
    chosen = [masks[name] for name in names] + ([] if wanted is None else [wanted])
    episodes = np.logical_and.reduce(chosen).nonzero()[0]
    if not len(episodes):
        those = "" if wanted is None else " of those that are asked for"
        raise ValueError(f"dataset {table.dataset.root}: no episode{those} in its {split} split")
    return episodes[evenly_spread(len(episodes), at_most)]


def evenly_spread(count: int, at_most: int) -> np.ndarray:
    """At most `at_most` of the indices below `count`, the first and the last among them."""
    return np.linspace(0, count - 1, min(count, at_most)).astype(int)
