"""What a task is: how an episode starts, when it has succeeded, what it pays. Pure numpy, no simulator.

Frame of reference: the robot's base axes, metres, x away from the robot, table top at z = 0.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from lerobot_wmrl.common.constants import TASKS as TASK_NAMES
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS, ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.scenes import Scene

CONTAINER_PLACE: Final = (0.02, -0.19)
"""Where a container that is only scenery stands (x, y)."""

REACH_SCALE: Final = 8.0
"""Steepness (1/m) with which a reward falls off with a distance."""

REACH_WEIGHT: Final = 0.3
"""Share of a reward that is paid for reaching the object; the rest is for moving it."""

ALMOST: Final = 0.9
"""Of the reward, the most that is paid before success."""


REST_SPEED: Final = 0.05
"""An object that moves no faster (m/s) lies still."""


@dataclass(frozen=True)
class Start:
    """The state in which an episode begins.

    Args:
        object_xy: of the object's centre (2,).
        object_yaw: rotation about z (rad).
        container_xy: of the container's centre (2,).
        tcp: position of the tool centre point (3,).
        instruction: what the policy is told.
        gripper_open: whether the gripper starts open.
        carpet_xy: of the mat's centre (2,), where the task has one.
    """

    object_xy: np.ndarray
    object_yaw: float
    container_xy: np.ndarray
    tcp: np.ndarray
    instruction: str
    gripper_open: bool = False
    carpet_xy: np.ndarray | None = None


@dataclass(frozen=True)
class Situation:
    """What a task judges.

    Args:
        start: of the episode; object_start (3,), where its object came to rest.
        spec, container: what is manipulated, and what stands beside it.
        object_now: its centre (3,).
        object_speed: of the centre during the last control step (m/s); the physics engine's own velocity
            trembles in a firm grasp.
        tcp: of the gripper (3,). gripper_opening: 0 closed to 1 open.
    """

    start: Start
    spec: ObjectSpec
    container: ContainerSpec
    object_start: np.ndarray
    object_now: np.ndarray
    tcp: np.ndarray
    gripper_opening: float = 0.0
    object_speed: float = 0.0

    @property
    def moved(self) -> np.ndarray:
        """Of the object since the start. (3,)"""
        return self.object_now - self.object_start

    @property
    def on_table(self) -> bool:
        """Neither fallen down nor held up."""
        height = self.object_now[2]
        return bool(0.4 * min(self.spec.half_size) < height < max(self.spec.half_size) + 0.01)


def nearness(distance: float) -> float:
    """1 at distance 0, falling to 0. Metres → [0, 1]"""
    return float(1.0 - np.tanh(REACH_SCALE * distance))


class Task(ABC):
    """One manipulation task. Register an instance in `TASKS` to make it known everywhere."""

    name: ClassVar[str]
    horizon: ClassVar[int]
    templates: ClassVar[tuple[str, ...]]

    @property
    def index(self) -> int:
        """Its number in the vocabulary of `start.task`."""
        return TASK_NAMES.index(self.name)

    def start(self, scene: Scene, seed: int) -> Start:
        """The start of (task, scene, seed): the same arguments give the same start."""
        rng = np.random.default_rng((seed, self.index, scene.index))
        template = self.templates[rng.integers(len(self.templates))]
        instruction = template.format(
            object=OBJECTS[scene.object].label, container=CONTAINERS[scene.container].label
        )
        return self.sample_start(rng, instruction)

    @abstractmethod
    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        """Draw a start."""

    @abstractmethod
    def success(self, situation: Situation) -> bool:
        """Whether the task is solved in this situation."""

    @abstractmethod
    def progress(self, situation: Situation) -> tuple[float, float]:
        """How near the gripper is to where it is needed, and how far the object has come, both in [0, 1]."""

    def reward(self, situation: Situation) -> float:
        """The rule-based dense reward, in [0, 1]: reaching, then moving the object; 1 on success."""
        if self.success(situation):
            return 1.0
        reach, moved = self.progress(situation)
        return float(REACH_WEIGHT * reach + (1.0 - REACH_WEIGHT) * ALMOST * moved)


def scenery_place(rng: np.random.Generator) -> np.ndarray:
    """Where a container stands that the task does not need. (2,)"""
    return np.array(CONTAINER_PLACE) + rng.uniform(-0.01, 0.01, 2)
