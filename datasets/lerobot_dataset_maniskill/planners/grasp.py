"""Grasping from above along y, where every object is narrow enough for the gripper."""

from abc import abstractmethod
from dataclasses import replace
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import CLOSED, OPEN, Waypoint, above_table
from lerobot_dataset_maniskill.planners.kinds import Planner, Waypoints
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.tasks import Start

ABOVE: Final = 0.05
"""Between fingertips and the object's top before the gripper goes down (m)."""

CLOSING_STEPS: Final = 6
OPENING_STEPS: Final = 4


class GraspPlanner(Planner):
    """Takes the object, then does something with it."""

    def __init__(self, spec: ObjectSpec, container: ContainerSpec, start: Start) -> None:
        super().__init__(spec, container, start)
        self.grasp_height = max(spec.half_size[2], 0.016)
        self.top = 2.0 * spec.half_size[2]

    @abstractmethod
    def deliver(self, target: np.ndarray) -> Waypoints:
        """Take the grasped object to `target` (2,)."""

    @property
    @abstractmethod
    def target(self) -> np.ndarray:
        """Where the object belongs. (2,)"""

    @property
    @abstractmethod
    def margins(self) -> tuple[float, float]:
        """Least and most distance from the target at which the object is missed, or hardly so (m)."""

    def beside_target(self, rng: np.random.Generator) -> np.ndarray:
        """Where the object does not belong any more, or hardly. (2,)"""
        angle, outside = rng.uniform(-np.pi, np.pi), rng.uniform(*self.margins)
        return self.target + outside * np.array([np.cos(angle), np.sin(angle)])

    def essential(self) -> Waypoints:
        return (*self.grasp(), *self.deliver(self.target))

    def grasp(self, offset: tuple[float, float] = (0.0, 0.0), height: float | None = None) -> Waypoints:
        """Down to `height` at the object's place + `offset`, and close."""
        xy = self.start.object_xy + offset
        low = self.grasp_height if height is None else height
        return (
            Waypoint(over(xy, self.top + ABOVE), 0.015, OPEN, clear=True),
            Waypoint(over(xy, low), 0.007, OPEN),
            Waypoint(over(xy, low), 0.02, CLOSED, dwell=CLOSING_STEPS),
        )

    def detour(self, rng: np.random.Generator) -> np.ndarray:
        """Around the object, above it."""
        x, y = self.start.object_xy + rng.uniform(-0.08, 0.08, 2)
        return np.array([x, y, rng.uniform(self.top + 0.04, 0.2)])

    def near_miss(self, rng: np.random.Generator) -> Waypoints:
        """The gripper closes beside or above the object, too early or too late; or delivers it elsewhere."""
        delivery = self.deliver(self.target)
        form = int(rng.integers(6))
        if form == 0:
            side = rng.choice((-1.0, 1.0)) * rng.uniform(0.015, 0.06)
            return (*self.grasp((side, 0.0) if rng.random() < 0.5 else (0.0, side)), *delivery)
        if form == 1:
            return (*self.grasp(height=self.top + rng.uniform(-0.004, 0.03)), *delivery)
        if form == 2:
            high, low, close = self.grasp()
            return (replace(high, gripper=CLOSED), Waypoint(low.position, 0.03), close, *delivery)
        if form == 3:
            return (*self.grasp()[:-1], *delivery)
        return (*self.grasp(), *self.deliver(self.beside_target(rng)))


def over(xy: np.ndarray, height: float) -> np.ndarray:
    """TCP position (3,) at `height` over (x, y)."""
    return above_table(np.array([*xy, height]))
