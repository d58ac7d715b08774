"""Driven episodes as a LeRobotDataset."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.embodiment import Embodiment
from lerobot_wmrl.data.episodes import open_dataset
from lerobot_wmrl.play.drive import Step
from lerobot_wmrl.rl.recorders import episode_features, observation_row


class SavedEpisodes:
    """A dataset to which driven episodes are added. It is whole on disk after each of them.

    Args:
        folder: of the dataset, which is new or has been written by this class.
        robot: whose actions and states these are.
        success_frames: number of frames at the end of a successful episode in which success holds.
    """

    def __init__(self, folder: Path, robot: Embodiment, success_frames: int) -> None:
        self.folder, self.robot, self.success_frames = folder, robot, success_frames
        self.name = f"local/{folder.name}"
        recover(folder)
        self.count = open_dataset(folder).num_episodes if folder.is_dir() else 0

    def add(self, steps: Sequence[Step], instruction: str, success: bool) -> int:
        """Add an episode. Return its index.

        Args:
            steps: of the drive.
            instruction: the task.
            success: whether it succeeds at its end.

        Raises:
            FieldError: there is no step, or the dataset has other columns.
        """
        if not steps:
            raise FieldError("save", 0, "nothing has been driven yet", "drive first")
        features = episode_features(steps[0].before, self.robot, "image")
        with replacing(self.folder) as folder:
            self._write(self._open(folder, features), steps, instruction, success)
        self.count += 1
        return self.count - 1

    def _write(self, dataset: LeRobotDataset, steps: Sequence[Step], instruction: str, success: bool) -> None:
        for index, step in enumerate(steps):
            last = index == len(steps) - 1
            solved = success and index >= len(steps) - self.success_frames
            frame: dict[str, Any] = {
                **observation_row(step.before, 0), ACTION: step.action, "task": instruction,
                "next.reward": np.array([step.reward], np.float32),
                "next.success": np.array([solved]), "next.done": np.array([last]),
            }  # fmt: skip
            dataset.add_frame(frame)
        dataset.save_episode()
        dataset.finalize()

    def _open(self, folder: Path, features: dict[str, Any]) -> LeRobotDataset:
        """Return the dataset in `folder`, ready to be added to; a new one if there is none."""
        if not folder.is_dir():
            return LeRobotDataset.create(self.name, self.robot.fps, features, root=folder, use_videos=False)
        dataset = LeRobotDataset.resume(self.name, root=folder)
        found, wanted = (
            {name: tuple(each["shape"]) for name, each in columns.items() if name not in DEFAULT_FEATURES}
            for columns in (dataset.features, features)
        )
        if found != wanted:
            raise FieldError(
                "output_dir", self.folder, f"holds episodes with the columns {found}, these have {wanted}",
                "choose a new folder",
            )  # fmt: skip
        return dataset


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Give a copy of a dataset's folder to add to, which then takes its place.

    LeRobot adds new files of episodes and never changes old ones, so these are not copied but linked.
    """
    partial, old = beside(folder)
    shutil.rmtree(partial, ignore_errors=True)
    partial.parent.mkdir(parents=True, exist_ok=True)
    if folder.is_dir():
        shutil.copytree(folder, partial, copy_function=link_or_copy)
    yield partial
    if folder.is_dir():
        folder.replace(old)
    partial.replace(folder)
    shutil.rmtree(old, ignore_errors=True)


def link_or_copy(source: str, target: str) -> None:
    """Link a file of episodes, copy any other."""
    if Path(source).name.startswith("file-"):
        os.link(source, target)
    else:
        shutil.copy2(source, target)


def recover(folder: Path) -> None:
    """Put back a folder whose replacement was interrupted."""
    partial, old = beside(folder)
    if old.is_dir() and not folder.exists():
        old.replace(folder)
    for leftover in (partial, old):
        shutil.rmtree(leftover, ignore_errors=True)


def beside(folder: Path) -> tuple[Path, Path]:
    """Return the folders in which a dataset's replacement is made, and its former state kept."""
    return folder.with_name(f".{folder.name}.partial"), folder.with_name(f".{folder.name}.old")
