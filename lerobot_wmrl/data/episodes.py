"""Episodes of a LeRobotDataset: all columns but the pictures, and checks of a dataset against a model."""

import hashlib
import logging
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.compute
import pyarrow.dataset
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR, BackwardCompatibilityError
from lerobot.utils.constants import ACTION, DONE, OBS_IMAGE, OBS_IMAGES, OBS_STATE
from numpy.typing import ArrayLike

from lerobot_wmrl.common.errors import FieldError, first_line, renamed
from lerobot_wmrl.common.statistics import evenly_spaced

VIDEO_BACKEND: Final = "pyav"
"""pyav ships its own FFmpeg, torchcodec needs the system's. Speed matters little: frames are decoded once."""

OLDER_FORMAT: Final = (BackwardCompatibilityError, NotImplementedError)
"""What LeRobot raises for version 2.1, and for those before."""

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


@dataclass
class DatasetSource:
    """A LeRobotDataset, on disk or on the hub.

    Args:
        root: folder of the dataset on disk.
        repo_id: name of the dataset on the hub. It is downloaded if it is not in `root`: there, or without
            `root` into LeRobot's cache.
        revision: branch, tag or commit to download; by default the one of LeRobot's dataset version.
    """

    root: str = ""
    repo_id: str | None = None
    revision: str | None = None

    def __post_init__(self) -> None:
        """Write the folder's path in one way, without a slash at its end."""
        self.root = str(Path(self.root)) if self.root else ""

    @property
    def given(self) -> bool:
        """Whether a dataset is named."""
        return bool(self.root or self.repo_id)

    @property
    def name(self) -> str:
        """The folder, or the name on the hub, for messages and file names."""
        return self.root or self.repo_id or ""

    def flags(self) -> dict[str, Any]:
        """Return the flags that name the dataset on a command line."""
        named = {"root": self.root} if self.root else {"repo_id": self.repo_id, "revision": self.revision}
        return {f"dataset.{name}": value for name, value in named.items() if value}

    def open(self) -> LeRobotDataset:
        """Open the dataset; download it first if it has a name on the hub and is not in `root`.

        Raises:
            FieldError: there is none, it is not whole, or it cannot be downloaded.
        """
        if self.repo_id and not (self.root and Path(self.root).exists()):
            return download_dataset(self.repo_id, self.revision, self.root or None)
        if self.revision:
            raise FieldError(
                "dataset.revision", self.revision, f"chooses what is downloaded, and {self.root} is there",
                "leave it out, or give another `dataset.root`",
            )  # fmt: skip
        return open_dataset(self.root, self.repo_id)


@dataclass
class ChosenEpisodes(DatasetSource):
    """Episodes of a LeRobotDataset.

    Args:
        episodes: indices of the episodes to use, as in lerobot-train; by default all. Every twentieth episode
            of the whole dataset is held out from training, chosen or not.
    """

    episodes: list[int] | None = None

    def flags(self) -> dict[str, Any]:
        return super().flags() | ({} if self.episodes is None else {"dataset.episodes": self.episodes})


@dataclass
class TrainingData(ChosenEpisodes):
    """A dataset to learn from.

    Args:
        more: folders of further datasets. Every second batch comes from one of them, in turn, so that half of
            the batches are old and half new (Ball et al. 2023).
    """

    more: list[str] = field(default_factory=list)

    def read_more(self) -> list["EpisodeTable"]:
        """Read the further datasets. FieldError if one cannot be read."""
        with renamed("dataset.root", "dataset.more"):
            return [read_episodes(open_dataset(root)) for root in self.more]


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

    def rows(self, episodes: Iterable[int]) -> list[slice]:
        """Return where each of the episodes has its frames."""
        return [slice(self.start[each], self.start[each] + self.length[each]) for each in episodes]

    def subset(self, episodes: np.ndarray) -> "EpisodeTable":
        """Return some of the episodes, a mask (E,) or indices; `validation` means nothing in the result."""
        columns = {name: values[episodes] for name, values in self.columns.items()}
        return replace(
            self, start=self.start[episodes], length=self.length[episodes], columns=columns,
            instructions=np.array(self.instructions, object)[episodes].tolist(),
        )  # fmt: skip

    def among(self, chosen: Sequence[int] | None) -> np.ndarray:
        """Mark the episodes that are `chosen`, all if None. FieldError names one that does not exist. (E,)"""
        indices = np.arange(len(self.start))
        for episode in chosen or ():
            if not 0 <= episode < len(indices):
                raise FieldError(
                    "dataset.episodes", list(chosen or ()),
                    f"there is no episode {episode} in {self.dataset.root}",
                    f"it has episodes 0 to {len(indices) - 1}",
                )  # fmt: skip
        return indices >= 0 if chosen is None else np.isin(indices, chosen)


def open_dataset(root: str | Path, repo_id: str | None = None) -> LeRobotDataset:
    """Open a local LeRobotDataset. FieldError if there is none at `root`, or it is not whole."""
    if not (Path(root) / "meta" / "info.json").is_file():
        raise FieldError(
            "dataset.root", root, "no LeRobotDataset there (meta/info.json is missing)", "record one first"
        )
    name = repo_id or Path(root).name
    try:
        missing = missing_files(Path(root))
        if not missing:
            return LeRobotDataset(name, root=root, video_backend=VIDEO_BACKEND)
    except OLDER_FORMAT as error:
        raise older_format("dataset.root", root, name, root) from error
    except Exception as error:  # parquet, JSON, datasets and the hub each raise their own
        reason = first_line(error.__cause__ or error)
        raise FieldError(
            "dataset.root",
            root,
            f"cannot be opened ({reason})",
            "see that its files may be read and are whole; what is torn, copy or download again, and only if "
            "there is no other copy, record it again",
        ) from error
    raise FieldError(
        "dataset.root", root, f"{len(missing)} files are missing, the first is {missing[0]}",
        "copy or download the dataset again, and only if there is no other copy, record it again",
    )  # fmt: skip


def download_dataset(repo_id: str, revision: str | None = None, root: str | None = None) -> LeRobotDataset:
    """Download a dataset of the hub, to `root` or LeRobot's cache, and open it. FieldError if that fails."""
    try:
        return LeRobotDataset(repo_id, root=root, revision=revision, video_backend=VIDEO_BACKEND)
    except Exception as error:  # the hub's client, parquet and JSON each raise their own
        if isinstance(error, OLDER_FORMAT) and revision is None:
            copy = Path("data") / repo_id.rpartition("/")[2]
            raise older_format("dataset.repo_id", repo_id, repo_id, copy) from error
        raise FieldError(
            "dataset.repo_id", repo_id, f"cannot be downloaded ({first_line(error)})",
            "correct the name, log in with `hf auth login` if it is private, or give a folder on disk, "
            "`dataset.root`",
        ) from error  # fmt: skip


def older_format(field: str, value: object, repo_id: str, root: str | Path) -> FieldError:
    """Return the error about a dataset before v3.0, with the command that converts it into the folder `root`:
    what is there, or what it downloads."""
    script = "python -m lerobot.scripts.convert_dataset_v21_to_v30"
    return FieldError(
        field, value, "is in a format before LeRobotDataset v3.0",
        "convert it (LeRobot converts v2.1; what is older, first by an earlier LeRobot to v2.1): "
        f"`{script} --repo-id={repo_id} --root={root} --push-to-hub=false`, and give `dataset.root` {root}. "
        "The old files are kept beside it",
    )  # fmt: skip


def fingerprint(root: Path) -> str:
    """Return a short hash of a dataset's folder `meta`, which changes with episodes, columns and values."""
    files = sorted(path for suffix in ("json", "parquet") for path in (root / "meta").rglob(f"*.{suffix}"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def missing_files(root: Path) -> list[Path]:
    """Return files that the table of episodes names and that are not there; LeRobot would ask the hub for
    them.

    The table is read without LeRobot's metadata, which takes as long to open as the whole dataset, and looks
    each path up by itself. Where there is no table, LeRobot says why: the dataset's version is older.
    """
    tables = sorted((root / EPISODES_DIR).glob("*/*.parquet"))
    if not tables:
        return []
    info, named = load_info(root), set[Path]()
    table = pyarrow.dataset.dataset([str(each) for each in tables], format="parquet")
    if (rows := table.count_rows()) != info.total_episodes:
        raise ValueError(f"{EPISODES_DIR} has {rows} of {info.total_episodes} episodes")
    files = [("data", info.data_path)]
    for key, feature in info.features.items():
        if feature["dtype"] == "video":
            files.append((f"videos/{key}", str(info.video_path)))
    for kind, pattern in files:
        places = table.to_table([f"{kind}/chunk_index", f"{kind}/file_index"]).to_pydict().values()
        for chunk, file in set(zip(*places, strict=True)):
            key = kind.removeprefix("videos/")
            named.add(Path(pattern.format(video_key=key, chunk_index=chunk, file_index=file)))
    return sorted(path for path in named if not (root / path).is_file())


def read_episodes(dataset: LeRobotDataset) -> EpisodeTable:
    """Read the columns that models train on. FieldError names a missing one, or one with NaN or infinity."""
    if ACTION not in dataset.features:
        raise FieldError(
            "dataset.root", dataset.root,
            f"the feature {ACTION!r} is missing (it has {', '.join(dataset.features)})",
            "world models need what was done beside what was seen",
        )  # fmt: skip
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
    _, start, length = np.unique(rows["episode_index"], return_index=True, return_counts=True)
    done = np.asarray(rows[success]).reshape(-1).astype(bool) if success else np.zeros(frames, bool)
    inferred, ending = None, end_at_success(done, start, length)
    # next.done may say no more than that episodes end
    if success != DONE and 2 * ending.sum() > np.logical_or.reduceat(done, start).sum():
        logging.warning(
            "%s: most episodes end as soon as they succeed, so that no frame shows success. The last %d "
            "frames of those that do are taken for solved; record a few more, if you can",
            dataset.root, SOLVED_FRAMES,
        )  # fmt: skip
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
            "whole episode", dataset.root, several, len(start),
        )  # fmt: skip
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


def bad_row(dataset: LeRobotDataset, column: str, row: int, found: object) -> FieldError:
    """Return the error for a row of a column, N rows in all, at which `found` is no value to learn from."""
    episode = np.asarray(
        dataset.hf_dataset.with_format("numpy", columns=["episode_index"])[:]["episode_index"]
    )
    frame = row - int(np.argmax(episode == episode[row]))
    return FieldError(
        "dataset.root", dataset.root, f"{column} of episode {episode[row]}, frame {frame}, is {found}",
        "remove the episode with lerobot-edit-dataset --operation.type=delete_episodes "
        f"--operation.episode_indices=[{episode[row]}]",
    )  # fmt: skip


def parquet_files(root: Path) -> list[Path]:
    """Return the files that hold a dataset's rows, in order."""
    return sorted((root / "data").rglob("*.parquet"))


def read_actions(root: Path) -> np.ndarray:
    """Read all actions of a dataset on disk. (rows, A) float64"""
    table = pyarrow.dataset.dataset(parquet_files(root), format="parquet").to_table(columns=[ACTION])
    column = table[ACTION]
    values = pyarrow.compute.list_flatten(column) if pyarrow.types.is_nested(column.type) else column
    return values.to_numpy().astype(np.float64).reshape(table.num_rows, -1)


def choose_episodes(
    table: EpisodeTable, split: str, at_most: int, further: Mapping[str, np.ndarray] | None = None,
    wanted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
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


def frame_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """Return (H, W) of a camera's feature, whose shape is (H, W, 3) or (3, H, W).

    Its names say which, if one of them is that of the channels; else the shape does.
    """
    shape, names = tuple(feature["shape"]), feature.get("names") or ()
    channels = [axis for axis, name in enumerate(names) if str(name).startswith("channel")]
    first = channels[0] == 0 if channels else shape[0] in (1, 3) and shape[-1] not in (1, 3)
    height, width = shape[1:] if first else shape[:2]
    return height, width


def check_cameras(features: Mapping[str, Any], camera_keys: Sequence[str]) -> None:
    """Raise FieldError unless the dataset has these cameras."""
    for key in camera_keys:
        if key not in features:
            cameras = ", ".join(name for name in features if name.startswith(OBS_IMAGE)) or "none"
            raise FieldError(
                "tokenizer.cameras", camera_names(camera_keys),
                f"the dataset has no {key} (its cameras: {cameras})",
                "set `tokenizer.cameras` to match, or use a dataset with this camera",
            )  # fmt: skip


def camera_names(camera_keys: Sequence[str]) -> list[str]:
    """Return the cameras' names without the prefix of their keys."""
    return [key.removeprefix(f"{OBS_IMAGES}.") for key in camera_keys]


def depth_key(camera_key: str) -> str:
    """Return the dataset's key of a camera's depth."""
    return f"{camera_key}_depth"


def check_depth(features: Mapping[str, Any], camera_keys: Sequence[str]) -> None:
    """Raise FieldError unless the dataset has the depth of these cameras."""
    for key in map(depth_key, camera_keys):
        if key not in features:
            raise FieldError(
                "depth", True, f"the world model looks at {key}, which the dataset lacks",
                "record it with lerobot-wmrl-record --depth=true",
            )  # fmt: skip


def require_shown(table: EpisodeTable, episodes: Iterable[int]) -> None:
    """Raise FieldError if episodes succeed and none of their frames shows it."""
    if not table.shows_success(episodes):
        raise FieldError(
            "dataset.root", table.dataset.root,
            f"{success_column(table.dataset.features)} is true in the last rows of episodes alone, and the "
            "frame after the last action is not recorded: no frame shows success",
            "label it anew: lerobot-wmrl-label with --success.type=ends takes the last frames for solved",
        )  # fmt: skip


def check_widths(features: Mapping[str, Any], wanted: Mapping[str, int]) -> None:
    """Raise ValueError unless the features have as many components as a model was trained with, 0 for any."""
    for name, width in wanted.items():
        found = features[name]["shape"][0] if name in features else 0
        if width and found != width:
            raise ValueError(
                f"{name}: the world model was trained with {width} components, the dataset has "
                f"{found or 'none'}; use a dataset like the one it was trained on"
            )


def check_statistics(meta: Any, key: str) -> None:
    """Raise FieldError unless a dataset's statistics of a feature are a finite number for each component."""
    size = int(np.prod(meta.features[key]["shape"]))
    for name in ("mean", "std"):
        found = np.asarray((meta.stats or {}).get(key, {}).get(name, ()), np.float64).reshape(-1)
        if len(found) != size or not np.isfinite(found).all():
            raise FieldError(
                "dataset.root", meta.root,
                f"its statistics (meta/stats.json) say that the {name} of {key} is {found.tolist()}, where "
                f"{size} finite numbers should be",
                "compute them again with lerobot-edit-dataset --operation.type=recompute_stats",
            )  # fmt: skip


def check_episode_lengths(meta: Any) -> None:
    """Raise FieldError if no episode has a second frame to predict."""
    if meta.total_frames <= meta.total_episodes:
        raise FieldError(
            "dataset.root", meta.root, f"{meta.total_episodes} episodes of {meta.total_frames} frames in all",
            "a world model learns from episodes of two frames or more: record longer ones",
        )  # fmt: skip
