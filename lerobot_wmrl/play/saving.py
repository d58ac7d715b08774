"""Driven episodes as a LeRobotDataset."""

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.output_folders import hold_lock
from lerobot_wmrl.data.dataset import open_dataset, save_episode
from lerobot_wmrl.data.embodiment import Embodiment, check_same_robot
from lerobot_wmrl.data.features import episode_features, observation_row
from lerobot_wmrl.play.drive import Step

WAITING_SECONDS: Final = 30


class SavedEpisodes:
    """A dataset to which driven episodes are added. It is whole on disk after each of them, also if several
    servers add to it.

    Args:
        folder: folder of the dataset, which is new or has been written by this class.
        robot: robot whose actions and states these are.
        held: frames at the end of a successful episode in which success holds.

    Raises:
        FieldError: the folder holds something else, or episodes of another robot.
    """

    def __init__(self, folder: Path, robot: Embodiment, held: int) -> None:
        self.folder, self.robot, self.held = folder.resolve(), robot, held
        self.name = f"local/{folder.name}"
        recover(self.folder)
        self.count = 0
        if self.folder.is_dir() and any(self.folder.iterdir()):
            try:
                meta = open_dataset(self.folder).meta
                check_same_robot(robot, meta)
            except FieldError as error:
                raise FieldError("output_dir", folder, error.problem, "choose a new folder") from error
            self.count = meta.total_episodes

    def add(self, steps: Iterable[Step], count: int, instruction: str, success: bool) -> int:
        """Add an episode. Return its index.

        Args:
            steps: steps of the drive.
            count: how many there are.
            instruction: the task.
            success: whether it succeeds at its end.

        Raises:
            FieldError: there is no step, or the dataset has other columns.
        """
        if not count:
            raise FieldError("save", 0, "nothing has been driven yet", "drive first")
        features, driven = None, []  # imagined before anybody else has to wait, and kept as uint8
        for index, step in enumerate(steps):
            features = features or episode_features(step.before, self.robot, "image")
            solved = success and index >= count - self.held
            frame: dict[str, Any] = {
                **observation_row(step.before, 0),
                ACTION: step.action,
                "task": instruction,
                "next.reward": np.array([step.reward], np.float32),
                "next.success": np.array([solved]),
                "next.done": np.array([index == count - 1]),
            }
            driven.append(frame)
        assert features is not None, "there are steps"
        with replacing(self.folder) as folder:
            dataset = self._open(folder, features)
            for frame in driven:
                dataset.add_frame(frame)
            save_episode(dataset)
            dataset.finalize()
            self.count = dataset.meta.total_episodes
        return self.count - 1

    def _open(self, folder: Path, features: dict[str, Any]) -> LeRobotDataset:
        """Return the dataset in `folder`, ready to be added to; a new one if there is none."""
        if not folder.is_dir():
            return LeRobotDataset.create(self.name, self.robot.fps, features, root=folder, use_videos=False)
        dataset = LeRobotDataset.resume(self.name, root=folder)
        stored, wanted = (
            {name: tuple(each["shape"]) for name, each in columns.items() if name not in DEFAULT_FEATURES}
            for columns in (dataset.features, features)
        )
        if stored != wanted:
            raise FieldError(
                "output_dir",
                self.folder,
                f"holds episodes with the columns {stored}, these have {wanted}",
                "choose a new folder",
            )
        return dataset


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Give a copy of a dataset's folder to add to, which then takes its place.

    LeRobot adds new files of episodes and never changes old ones, so these are not copied but linked. Others
    who replace the same folder wait. FieldError if it takes too long.
    """
    partial, old = beside(folder)
    partial.parent.mkdir(parents=True, exist_ok=True)
    with exclusive(folder):
        put_back(folder)
        if folder.is_dir() and any(folder.iterdir()):
            shutil.copytree(folder, partial, copy_function=link_or_copy)
        yield partial
        if folder.is_dir():
            folder.replace(old)
        partial.replace(folder)
        shutil.rmtree(old, ignore_errors=True)


def link_or_copy(source: str, target: str) -> None:
    """Link a file of episodes, where the file system can; copy any other."""
    if Path(source).name.startswith("file-"):
        with suppress(OSError):
            os.link(source, target)
            return
    shutil.copy2(source, target)


def recover(folder: Path) -> None:
    """Put back a folder whose replacement was interrupted."""
    partial, old = beside(folder)
    if not (partial.exists() or old.exists()):
        return
    with exclusive(folder):
        put_back(folder)


def put_back(folder: Path) -> None:
    """Undo a replacement that was interrupted; to be called while the folder is held."""
    partial, old = beside(folder)
    if old.is_dir() and not folder.exists():
        old.replace(folder)
    for leftover in (partial, old):
        shutil.rmtree(leftover, ignore_errors=True)


def exclusive(folder: Path) -> AbstractContextManager[None]:
    """Hold a dataset while it is replaced. FieldError if somebody else does not come to an end."""
    return hold_lock(folder, folder.with_name(f".{folder.name}.lock"), WAITING_SECONDS)


def beside(folder: Path) -> tuple[Path, Path]:
    """Return the folders in which a dataset's replacement is made, and its former state kept."""
    return folder.with_name(f".{folder.name}.partial"), folder.with_name(f".{folder.name}.old")
