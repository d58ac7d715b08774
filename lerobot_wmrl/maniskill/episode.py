"""One episode as the simulator plays it: its frames, and what is kept to judge it. Imports no simulator."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from lerobot_wmrl.maniskill.embodiment import FPS
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Situation, Task

WORKSPACE_FLOOR: Final = 0.015
"""Lowest height of the TCP (m): the simulator stops it there, as a real robot's controller would. At 0.009
the fingertips scrape over the table, and how they stick and slip there can be neither learnt nor repeated."""


@dataclass(frozen=True)
class Frame:
    """What is observed at one control step.

    Args:
        images: camera → (H, W, 3) uint8.
        depth: camera → (H, W, 1) uint16, millimetres along the camera's axis, 0 where nothing is; empty
            unless depth was asked for.
        state: (8,) float32, `embodiment.STATE_NAMES`.
        reward: the task's dense reward at this frame.
        success: whether the task is solved at this frame.
    """

    images: dict[str, np.ndarray]
    depth: dict[str, np.ndarray]
    state: np.ndarray
    reward: float
    success: bool


class RunningEpisode:
    """What is kept of a running episode to judge it: its start, and where the object was.

    Args:
        task: with `scene` and `seed`, decides the start.
        scene: what is on the table.
        seed: seed of the episode.
    """

    object_start: np.ndarray
    object_before: np.ndarray

    def __init__(self, task: Task, scene: Scene, seed: int) -> None:
        self.scene, self.seed, self.start = scene, seed, task.start(scene, seed)

    def begin(self, position: np.ndarray) -> None:
        """Note that the object has been put at `position` (3,)."""
        self.object_start = self.object_before = position

    def situation(self, position: np.ndarray, tcp: np.ndarray, opening: float) -> Situation:
        """Return what the task judges when the object is at `position` (3,), the TCP at `tcp` (3,)."""
        return Situation(
            self.start,
            self.scene.object_spec,
            self.scene.container_spec,
            self.object_start,
            position,
            tcp,
            opening,
            float(np.linalg.norm(position - self.object_before)) * FPS,
        )
