"""Tasks: how an episode starts, when it has succeeded, what it pays. Pure numpy, no simulator.

Frame of reference: the robot's base axes, metres, x away from the robot, table top at z = 0.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from lerobot_wmrl.constants import TASKS as TASK_NAMES
from lerobot_wmrl.maniskill.scenes import Scene

CONTAINER_PLACE: Final = (0.02, -0.19)
"""Where a container that is only scenery stands (x, y)."""


@dataclass(frozen=True)
class Start:
    """The state in which an episode begins.

    Args:
        object_xy: of the object's centre (2,).
        object_yaw: rotation about z (rad).
        container_xy: of the container's centre (2,).
        tcp: position of the tool centre point (3,).
        instruction: what the policy is told.
    """

    object_xy: np.ndarray
    object_yaw: float
    container_xy: np.ndarray
    tcp: np.ndarray
    instruction: str


@dataclass(frozen=True)
class Situation:
    """What a task judges: the object at the start and now, the TCP, each (3,); the height of its centre."""

    object_start: np.ndarray
    object_now: np.ndarray
    tcp: np.ndarray
    object_height: float


class Task(ABC):
    """One manipulation task. Register an instance in `TASKS` to make it known everywhere."""

    name: ClassVar[str]
    horizon: ClassVar[int]
    templates: ClassVar[tuple[str, ...]]

    @property
    def index(self) -> int:
        """Its number in the vocabulary of `start.task`."""
        return TASK_NAMES.index(self.name)

    def start(self, scene: Scene, label: str, seed: int) -> Start:
        """The start of (task, scene, seed): the same arguments give the same start."""
        rng = np.random.default_rng((seed, self.index, scene.index))
        return self.sample_start(rng, self.templates[rng.integers(len(self.templates))].format(object=label))

    @abstractmethod
    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        """Draw a start."""

    @abstractmethod
    def success(self, situation: Situation) -> bool:
        """Whether the task is solved in this situation."""

    @abstractmethod
    def reward(self, situation: Situation) -> float:
        """The rule-based dense reward, in [0, 1]."""


class Push(Task):
    """Push the object forward: 10 cm along +x, at most 5 cm sideways."""

    name = "push"
    horizon = 40
    templates = (
        "push the {object} forward",
        "push the {object} away from the robot",
        "move the {object} forward by pushing it",
    )
    distance: ClassVar[float] = 0.10
    lateral_limit: ClassVar[float] = 0.05
    reach_weight: ClassVar[float] = 0.3

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy = rng.uniform((-0.05, -0.05), (0.01, 0.05))
        offset = rng.uniform((-0.16, -0.08), (-0.08, 0.08))
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=np.array(CONTAINER_PLACE) + rng.uniform(-0.01, 0.01, 2),
            tcp=np.array([*(object_xy + offset), rng.uniform(0.03, 0.16)]),
            instruction=instruction,
        )

    def success(self, situation: Situation) -> bool:
        moved = situation.object_now - situation.object_start
        on_table = situation.object_now[2] > 0.5 * situation.object_height
        return bool(moved[0] >= self.distance and abs(moved[1]) <= self.lateral_limit and on_table)

    def reward(self, situation: Situation) -> float:
        """Nearness of the TCP to the place behind the object, then progress of the object; 1 on success."""
        if self.success(situation):
            return 1.0
        moved = situation.object_now - situation.object_start
        behind = situation.object_now - np.array([0.03, 0.0, 0.0])
        reach = 1.0 - np.tanh(8.0 * np.linalg.norm(situation.tcp - behind))
        progress = np.clip(moved[0] / self.distance, 0.0, 1.0) * (abs(moved[1]) <= self.lateral_limit)
        return float(self.reach_weight * reach + (1.0 - self.reach_weight) * 0.9 * progress)


TASKS: Final[dict[str, Task]] = {task.name: task for task in (Push(),)}


def task_of(name: str | None) -> Task:
    """The registered task called `name`. ValueError if there is none."""
    if name not in TASKS:
        raise ValueError(f"task={name!r} is unknown; choose one of {', '.join(TASKS)}")
    return TASKS[name]
