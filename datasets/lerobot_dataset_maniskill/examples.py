"""One picture a task: an episode of the recording, from its start to success."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import KINDS, TASKS
from lerobot_wmrl.common.frame_strips import enlarged, evenly_spaced, in_a_row

MEDIA = Path("media")
FRAMES = 6
WIDTH = 192
"""Pixels that a frame is enlarged to, as far as a whole factor allows."""


@dataclass(frozen=True)
class Example:
    """An episode that shows its task."""

    task: str
    episode: int
    kind: str
    success: bool

    @property
    def path(self) -> Path:
        """Of its picture, from the dataset's root."""
        return MEDIA / f"{self.task}.png"


def chosen_examples(table: Mapping[str, np.ndarray]) -> list[Example]:
    """One episode of each recorded task: the first success, optimal if possible; else the first failure.

    `table` is `lerobot_wmrl.maniskill.recordings.recorded_episodes`.
    """
    best = np.lexsort((table["episode"], table["kind"], ~table["success"]))
    rows = [best[table["task"][best] == task][0] for task in np.unique(table["task"])]
    return [
        Example(
            TASKS[table["task"][row]],
            int(table["episode"][row]),
            KINDS[table["kind"][row]],
            bool(table["success"][row]),
        )
        for row in rows
    ]


def write_pictures(root: Path, repo_id: str, table: Mapping[str, np.ndarray]) -> None:
    """The picture of every example, in the folder `media` of the dataset at `root`."""
    (root / MEDIA).mkdir(exist_ok=True)
    for example in chosen_examples(table):
        dataset = LeRobotDataset(repo_id, root=root, episodes=[example.episode], return_uint8=True)
        frames = frames_to_success(dataset)
        enlarged(in_a_row(frames), max(1, WIDTH // frames.shape[2])).save(root / example.path)


def frames_to_success(dataset: LeRobotDataset) -> np.ndarray:
    """Frames of a dataset of one episode, evenly spaced from its start to success, or to its end.

    → (N, C·H, W, 3) uint8, its C cameras below each other
    """
    success = dataset.hf_dataset.with_format("numpy")["next.success"][:].reshape(-1)
    end = len(success)
    if success.any():
        end = min(int(success.argmax()) + 2, end)  # it shows in the frame after its row
    rows = [dataset[int(index)] for index in evenly_spaced(end, FRAMES)]
    coloured = [name for name in dataset.meta.camera_keys if name not in dataset.meta.depth_keys]
    cameras = [np.stack([row[name].numpy() for row in rows]) for name in coloured]
    return np.concatenate(cameras, 2).transpose(0, 2, 3, 1)
