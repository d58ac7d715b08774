"""Plans for pick_place and move_to_aim: grasp the object from above, then carry or slide it to the target.

The gripper closes along y, where every object is narrow enough for it.
"""

from abc import abstractmethod
from dataclasses import replace
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import CLOSED, OPEN, Waypoint, Waypoints, above_table
from lerobot_dataset_maniskill.planners.kinds import TaskPlanner
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.tasks import MoveToAim, Start

APPROACH_HEIGHT: Final = 0.05
"""Height of the fingertips above the object's top before the gripper goes down (m)."""

CLOSING_STEPS: Final = 6
OPENING_STEPS: Final = 4

CARRY_HEIGHT: Final = 0.06
"""Height of the carried object's underside above the container's rim (m)."""

DROP_HEIGHT: Final = 0.015
"""The same when the gripper opens (m)."""


class GraspPlanner(TaskPlanner):
    """Grasps the object, then delivers it to the task's target."""

    def __init__(self, spec: ObjectSpec, container: ContainerSpec, start: Start) -> None:
        super().__init__(spec, container, start)
        self.grasp_height = max(spec.half_size[2], 0.016)
        self.top = 2.0 * spec.half_size[2]

    @abstractmethod
    def deliver(self, target: np.ndarray) -> Waypoints:
        """Return waypoints that take the grasped object to `target` (2,)."""

    @property
    @abstractmethod
    def target(self) -> np.ndarray:
        """Target position of the object (2,), metres."""

    @property
    @abstractmethod
    def margins(self) -> tuple[float, float]:
        """Smallest and largest distance from the target (m) of a delivery that just misses it."""

    def beside_target(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a place (2,) just outside the target."""
        angle, outside = rng.uniform(-np.pi, np.pi), rng.uniform(*self.margins)
        return self.target + outside * np.array([np.cos(angle), np.sin(angle)])

    def essential(self) -> Waypoints:
        return (*self.grasp(), *self.deliver(self.target))

    def grasp(self, offset: tuple[float, float] = (0.0, 0.0), height: float | None = None) -> Waypoints:
        """Return waypoints: down to `height` (m) at the object's place + `offset` (m), then close."""
        xy = self.start.object_xy + offset
        low = self.grasp_height if height is None else height
        return (
            Waypoint(over(xy, self.top + APPROACH_HEIGHT), 0.015, OPEN, clear=True),
            Waypoint(over(xy, low), 0.007, OPEN),
            Waypoint(over(xy, low), 0.02, CLOSED, dwell=CLOSING_STEPS),
        )

    def detour(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a position (3,) around the object, above it."""
        x, y = self.start.object_xy + rng.uniform(-0.08, 0.08, 2)
        return np.array([x, y, rng.uniform(self.top + 0.04, 0.2)])

    def near_miss(self, rng: np.random.Generator) -> Waypoints:
        """Draw a failure: close at the wrong place or time, or deliver the object beside the target."""
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


class PickPlacePlanner(GraspPlanner):
    """Carries the object over the rim of the container, and drops it there."""

    @property
    def target(self) -> np.ndarray:
        return self.start.container_xy

    def deliver(self, target: np.ndarray) -> Waypoints:
        carry, drop = (self.container.height + gap + self.grasp_height for gap in (CARRY_HEIGHT, DROP_HEIGHT))
        return (
            Waypoint(over(self.start.object_xy, carry), 0.025),
            Waypoint(over(target, carry), 0.012),
            Waypoint(over(target, drop), 0.010),
            Waypoint(over(target, drop), 0.02, OPEN, dwell=OPENING_STEPS),
            Waypoint(over(target, carry + 0.03), 0.02, OPEN),
        )

    @property
    def margins(self) -> tuple[float, float]:
        return self.container.radius - 0.01, self.container.radius + 0.06


class MoveToAimPlanner(GraspPlanner):
    """Slides the grasped object over the table: pushed at an angle, most objects slip off the fingers."""

    @property
    def target(self) -> np.ndarray:
        assert self.start.carpet_xy is not None
        return self.start.carpet_xy

    def deliver(self, target: np.ndarray) -> Waypoints:
        return (Waypoint(over(target, self.grasp_height), 0.001),)

    @property
    def margins(self) -> tuple[float, float]:
        return MoveToAim.tolerance, MoveToAim.tolerance + 0.05


def over(xy: np.ndarray, height: float) -> np.ndarray:
    """Return the TCP position (3,) at `height` above `xy` (2,)."""
    return above_table(np.array([*xy, height]))
