"""Where LeRobotDatasets are: named on a command line, opened, downloaded, and known by what they hold."""

import hashlib
import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import pyarrow.compute
import pyarrow.dataset
from huggingface_hub import snapshot_download
from huggingface_hub.file_download import repo_folder_name
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION, LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR, BackwardCompatibilityError
from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE
from lerobot.utils.utils import SuppressProgressBars

from lerobot_wmrl.common.errors import FieldError, first_line, renamed
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.common.hub import cached_repo
from lerobot_wmrl.data.embodiment import whole_rate
from lerobot_wmrl.data.episodes import EpisodeTable, parquet_files, read_episodes, require_chosen

VIDEO_BACKEND: Final = "pyav"
"""pyav ships its own FFmpeg, torchcodec needs the system's. Speed matters little: frames are decoded once."""

HASHED_ROWS: Final = 65_536
"""Rows that are hashed at a time."""

OLDER_FORMAT: Final = (BackwardCompatibilityError, NotImplementedError)
"""What LeRobot raises for version 2.1, and for those before."""


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

    def pinned(self, opened: Path) -> Self:
        """Return this source with the commit that was opened, if it was downloaded: later the name may stand
        for another. opened: the folder."""
        return self if self.root or cached_repo(opened) is None else replace(self, revision=opened.name)

    def flags(self) -> dict[str, Any]:
        """Return the flags that name the dataset on a command line."""
        named = {"root": self.root} if self.root else {"repo_id": self.repo_id, "revision": self.revision}
        return {f"dataset.{name}": value for name, value in named.items() if value}

    def open(self) -> LeRobotDataset:
        """Open the dataset; download what is missing in `root` first if it has a name on the hub.

        Raises:
            FieldError: there is none, it is not whole, or it cannot be downloaded.
        """
        return self._open(None)

    def _open(self, episodes: Collection[int] | None) -> LeRobotDataset:
        """Open the dataset, with the videos of these episodes at least, of all if None."""
        if not self.given:
            raise FieldError(
                "dataset.root", self.root, "no dataset is named", "give `dataset.root` or `dataset.repo_id`"
            )
        if self.revision and not self.repo_id:
            raise FieldError(
                "dataset.revision",
                self.revision,
                "is one of a dataset on the hub, and none is named",
                "give `dataset.repo_id`, or leave it out",
            )
        root = self.root or self._recorded_here()
        if not self.repo_id or (root and (is_whole(Path(root), episodes) or unfinished(root))):
            if self.revision:
                logging.warning(
                    "dataset.revision=%s: %s holds a whole dataset, which is used as it is, whatever its "
                    "revision; give a new folder to download this one",
                    self.revision,
                    root,
                )
            return open_dataset(root, self.repo_id, episodes)
        try:
            return download_dataset(self.repo_id, self.revision, self.root or None, episodes)
        except FieldError as error:
            here = root and (Path(root) / "meta" / "info.json").is_file()
            if not here or error.field == "dataset.episodes":
                raise
        return open_dataset(root, self.repo_id, episodes)  # which says what is missing there

    def _recorded_here(self) -> str:
        """Return where LeRobot's recorder leaves a dataset of this name, and LeRobot looks first; empty if
        there is none."""
        folder = HF_LEROBOT_HOME / self.repo_id if self.repo_id else None
        return str(folder) if folder is not None and (folder / "meta" / "info.json").is_file() else ""


@dataclass
class ChosenEpisodes(DatasetSource):
    """Episodes of a LeRobotDataset.

    Args:
        episodes: indices of the episodes to use, as in lerobot-train; by default all. Every twentieth episode
            of the whole dataset is held out from training, chosen or not. Of a dataset on the hub, only the
            videos of these episodes are downloaded.
    """

    episodes: list[int] | None = None

    def open(self) -> LeRobotDataset:
        return self._open(self.episodes)

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


def open_dataset(
    root: str | Path, repo_id: str | None = None, episodes: Collection[int] | None = None
) -> LeRobotDataset:
    """Open a local LeRobotDataset. FieldError if there is none at `root`, or it is not whole.

    Args:
        episodes: those whose videos must be there; by default all.
    """
    if not (Path(root) / "meta" / "info.json").is_file():
        raise FieldError(
            "dataset.root", root, "no LeRobotDataset there (meta/info.json is missing)", "record one first"
        )
    if unfinished(root):
        raise FieldError(
            "dataset.root",
            root,
            f"its recording was not finished: it has no table of episodes ({EPISODES_DIR})",
            "record it again: LeRobot writes the table when a recording ends",
        )
    name = repo_id or Path(root).absolute().name
    try:
        lacking = missing_files(Path(root))
        missing = lacking and missing_files(Path(root), episodes)
        if not missing:
            dataset = open_rows(name, episodes if lacking else None, root=root)
    except FieldError:
        raise
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
    if missing:
        raise FieldError(
            "dataset.root",
            root,
            f"{len(missing)} files are missing, the first is {missing[0]}",
            "copy or download the dataset again, and only if there is no other copy, record it again",
        )
    return with_whole_rate(dataset, "dataset.root", root)


def with_whole_rate(dataset: LeRobotDataset, field: str, value: object) -> LeRobotDataset:
    """Return the dataset with its frame rate as the whole number that it is. FieldError if it is none."""
    dataset.meta.info.fps = whole_rate(dataset.meta.info.fps, field, value)
    return dataset


def save_episode(dataset: LeRobotDataset) -> None:
    """Save the episode whose frames were added, without a progress bar of its own, which datasets shows."""
    with SuppressProgressBars():
        dataset.save_episode()


def download_dataset(
    repo_id: str,
    revision: str | None = None,
    root: str | None = None,
    episodes: Collection[int] | None = None,
) -> LeRobotDataset:
    """Download a dataset of the hub, to `root` or LeRobot's cache, and open it. FieldError if that fails.

    Args:
        episodes: those whose videos are downloaded; by default all.
    """
    try:
        dataset = open_rows(repo_id, episodes, root=root, revision=revision)
    except FieldError:
        raise
    except Exception as error:  # the hub's client, parquet and JSON each raise their own
        if isinstance(error, OLDER_FORMAT) and revision is None:
            copy = Path("data") / repo_id.rpartition("/")[2]
            raise older_format("dataset.repo_id", repo_id, repo_id, copy) from error
        raise FieldError(
            "dataset.repo_id",
            repo_id,
            f"cannot be downloaded ({first_line(error)})",
            "correct the name, log in with `hf auth login` if it is private, or give a folder on disk, "
            "`dataset.root`",
        ) from error
    return with_whole_rate(dataset, "dataset.repo_id", repo_id)


def open_rows(repo_id: str, episodes: Collection[int] | None, **where: Any) -> LeRobotDataset:
    """Open a dataset with all its rows; LeRobot downloads what is missing of it.

    Args:
        episodes: those whose videos are needed, all if None.
        where: LeRobot's `root` and `revision`.

    Raises:
        FieldError: there is no episode among these, or one of them is not in the dataset.
    """
    open_videos_of = partial(LeRobotDataset, repo_id, video_backend=VIDEO_BACKEND, **where)
    if episodes is None:
        return open_videos_of()
    meta = LeRobotDatasetMetadata(repo_id, **where)
    require_chosen(episodes, meta.total_episodes, meta.root)
    dataset = open_videos_of(episodes=list(episodes))
    if missing_files(dataset.root, episodes):
        snapshot_download(
            repo_id,
            repo_type="dataset",
            revision=dataset.revision,
            allow_patterns="data/*",
            **({"local_dir": dataset.root} if where.get("root") else {"cache_dir": HF_LEROBOT_HUB_CACHE}),
        )
    dataset.episodes = dataset.reader.episodes = None
    dataset.reader.load_and_activate()
    return dataset


def local_copies(repo_id: str) -> list[Path]:
    """Return the folders in LeRobot's cache that hold a dataset of the hub, one a revision."""
    cached = HF_LEROBOT_HUB_CACHE / repo_folder_name(repo_id=repo_id, repo_type="dataset") / "snapshots"
    return sorted(path for path in cached.glob("*") if path.is_dir())


def older_format(field: str, value: object, repo_id: str, root: str | Path) -> FieldError:
    """Return the error about a dataset before v3.0, with the command that converts it into the folder `root`:
    what is there, or what it downloads."""
    script = "python -m lerobot.scripts.convert_dataset_v21_to_v30"
    return FieldError(
        field,
        value,
        "is in a format before LeRobotDataset v3.0",
        "convert it (LeRobot converts v2.1; what is older, first by an earlier LeRobot to v2.1): "
        f"`{script} --repo-id={repo_id} {flag_as_typed('root', root)} --push-to-hub=false`, "
        f"and give `dataset.root` {root}. The old files are kept beside it",
    )


def fingerprint(root: Path, meta: bool = True) -> str:
    """Return a short hash of a dataset's columns but pictures, and with `meta` of that folder too.

    `meta` alone says nothing of labels: LeRobot keeps no statistics of a column that was added.
    """
    kinds = ("json", "parquet") if meta else ()
    files = sorted(path for suffix in kinds for path in (root / "meta").rglob(f"*.{suffix}"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files))
    pictures = {name for name, each in load_info(root).features.items() if each["dtype"] == "image"}
    rows = pyarrow.dataset.dataset(parquet_files(root), format="parquet")
    kept = [name for name in sorted(rows.schema.names) if name not in pictures]
    for batch in rows.to_batches(columns=kept, batch_size=HASHED_ROWS):
        digest.update(batch.replace_schema_metadata(None).serialize())
    return digest.hexdigest()[:12]


def is_whole(root: Path, episodes: Collection[int] | None = None) -> bool:
    """Return whether a dataset's folder has all its files, which a download that was stopped has not; of the
    videos those of `episodes`, all if None."""
    if not (root / "meta" / "info.json").is_file() or not any((root / EPISODES_DIR).glob("*/*.parquet")):
        return False
    try:
        return not missing_files(root, episodes)
    except (OSError, ValueError):  # a table that is torn, or one of several
        return False


def unfinished(root: str | Path) -> bool:
    """Return whether a folder holds a recording that was stopped: it has no table of episodes, nor is it a
    download."""
    root = Path(root)
    if not (root / "meta" / "info.json").is_file() or any((root / EPISODES_DIR).glob("*/*.parquet")):
        return False
    downloaded = (root / ".cache" / "huggingface").is_dir()
    try:
        return not downloaded and load_info(root).codebase_version == CODEBASE_VERSION
    except (OSError, ValueError, TypeError):  # of an older version, which LeRobot names, or torn
        return False


def missing_files(root: Path, episodes: Collection[int] | None = None) -> list[Path]:
    """Return files that the table of episodes names and that are not there; LeRobot would ask the hub for
    them. Of the videos, those of `episodes` count, all if None.

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
    chosen = None
    if episodes is not None:
        chosen = pyarrow.compute.field("episode_index").isin(pyarrow.array(episodes, pyarrow.int64()))
    files = [("data", info.data_path, None)]
    for key, feature in info.features.items():
        if feature["dtype"] == "video":
            files.append((f"videos/{key}", str(info.video_path), chosen))
    for kind, pattern, wanted in files:
        places = table.to_table([f"{kind}/chunk_index", f"{kind}/file_index"], wanted).to_pydict().values()
        for chunk, file in set(zip(*places, strict=True)):
            key = kind.removeprefix("videos/")
            named.add(Path(pattern.format(video_key=key, chunk_index=chunk, file_index=file)))
    return sorted(path for path in named if not (root / path).is_file())
