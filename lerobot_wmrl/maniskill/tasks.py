"""The tasks: how an episode starts, when it has succeeded, what it pays. Pure numpy, no simulator.

They are the one definition of success for the recorder, the environments and every evaluation. Positions are
in metres along the axes of the robot's base: x points away from the robot, the table top is at z = 0.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from lerobot_wmrl.common.constants import TASK_NAMES
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.scenes import Scene

SCENERY_XY: Final = (0.02, -0.19)
"""Where a container stands that the task does not use (m)."""

REACH_SCALE: Final = 8.0
"""Steepness (1/m) with which a reward falls off with a distance."""

REACH_WEIGHT: Final = 0.3
"""Share of a reward that is paid for reaching the object; the rest is for moving it."""

MAX_PROGRESS_REWARD: Final = 0.9
"""Share of the reward for moving the object that is paid before success."""

REST_SPEED: Final = 0.05
"""An object that moves no faster (m/s) lies still."""


@dataclass(frozen=True)
class Start:
    """The state in which an episode begins.

    Args:
        object_xy: centre of the object (2,).
        object_yaw: rotation of the object about z (rad).
        container_xy: centre of the container (2,).
        tcp: position of the tool centre point (3,).
        instruction: what the policy is told.
        gripper_open: whether the gripper starts open.
        carpet_xy: centre of the mat (2,); None for tasks without a mat.
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
    """What a task judges: the present state of an episode, and how it started.

    Args:
        start: how the episode started.
        spec: the object that is manipulated.
        container: the container on the table.
        object_start: centre of the object once it had come to rest at the start (3,).
        object_now: centre of the object (3,).
        tcp: position of the tool centre point (3,).
        gripper_opening: from 0 (closed) to 1 (open).
        object_speed: mean speed of the object's centre during the last control step (m/s). The velocity that
            the physics engine reports trembles in a firm grasp.
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
        """Displacement of the object since the start (3,)."""
        return self.object_now - self.object_start

    @property
    def on_table(self) -> bool:
        """Whether the object has neither fallen down nor been lifted."""
        height = self.object_now[2]
        return bool(0.4 * min(self.spec.half_size) < height < max(self.spec.half_size) + 0.01)


def nearness(distance: float) -> float:
    """Map a distance (m) to [0, 1]: 1 at distance 0, falling towards 0."""
    return float(1.0 - np.tanh(REACH_SCALE * distance))


class Task(ABC):
    """One manipulation task. An instance in `TASKS` makes it known everywhere.

    `horizon` is the number of steps after which an episode is truncated; `templates` are the forms of its
    instruction.
    """

    name: ClassVar[str]
    horizon: ClassVar[int]
    templates: ClassVar[tuple[str, ...]]

    @property
    def index(self) -> int:
        """Index of the task in the dataset's column `start.task`."""
        return TASK_NAMES.index(self.name)

    def start(self, scene: Scene, seed: int) -> Start:
        """Return the start of (task, scene, seed). The same arguments give the same start."""
        rng = np.random.default_rng((seed, self.index, scene.index))
        template = self.templates[rng.integers(len(self.templates))]
        instruction = template.format(object=scene.object_spec.label, container=scene.container_spec.label)
        return self.sample_start(rng, instruction)

    @abstractmethod
    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        """Draw a start with this instruction."""

    @abstractmethod
    def success(self, situation: Situation) -> bool:
        """Return whether the task is solved in this situation."""

    @abstractmethod
    def progress(self, situation: Situation) -> tuple[float, float]:
        """Return how near the gripper is to where it is needed, and the object's progress, both in [0, 1]."""

    def reward(self, situation: Situation) -> float:
        """Return the dense reward in [0, 1]: paid for reaching, then for moving the object; 1 on success."""
        if self.success(situation):
            return 1.0
        reach, moved = self.progress(situation)
        return float(REACH_WEIGHT * reach + (1.0 - REACH_WEIGHT) * MAX_PROGRESS_REWARD * moved)


def scenery_place(rng: np.random.Generator) -> np.ndarray:
    """Draw where a container stands that the task does not use. Returns (2,), metres."""
    return np.array(SCENERY_XY) + rng.uniform(-0.01, 0.01, 2)


CONTACT_DISTANCE: Final = 0.03
"""Distance behind the object's centre of the place that the reward draws the gripper to (m)."""

Area = tuple[tuple[float, float], tuple[float, float]]
"""Lowest and highest (x, y), in metres."""


class Slide(Task):
    """Push or pull: move the object by `distance` along `direction`·x, at most `lateral_limit` sideways.

    The object starts in `object_area`, the TCP at an offset from it in `tcp_offset` and at a height in
    `tcp_height`.
    """

    direction: ClassVar[float]
    distance: ClassVar[float] = 0.10
    lateral_limit: ClassVar[float] = 0.05
    object_area: ClassVar[Area]
    tcp_offset: ClassVar[Area]
    tcp_height: ClassVar[tuple[float, float]]

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy, offset = rng.uniform(*self.object_area), rng.uniform(*self.tcp_offset)
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=scenery_place(rng),
            tcp=np.array([*(object_xy + offset), rng.uniform(*self.tcp_height)]),
            instruction=instruction,
        )

    def success(self, situation: Situation) -> bool:
        forward, sideways, _ = situation.moved
        far = self.direction * forward >= self.distance
        return bool(far and abs(sideways) <= self.lateral_limit and situation.on_table)

    def progress(self, situation: Situation) -> tuple[float, float]:
        """Return nearness of the TCP to the place behind the object, and the share of the distance.

        The share is 0 once the object is too far to one side.
        """
        forward, sideways, _ = situation.moved
        behind = situation.object_now - np.array([self.direction * CONTACT_DISTANCE, 0.0, 0.0])
        share = np.clip(self.direction * forward / self.distance, 0.0, 1.0)
        reach = nearness(float(np.linalg.norm(situation.tcp - behind)))
        return reach, float(share * (abs(sideways) <= self.lateral_limit))


class Push(Slide):
    """Push the object forward: 10 cm along +x, at most 5 cm sideways."""

    name = "push"
    horizon = 40
    direction = 1.0
    object_area = ((-0.05, -0.05), (0.01, 0.05))
    tcp_offset = ((-0.16, -0.08), (-0.08, 0.08))
    tcp_height = (0.03, 0.16)
    templates = (
        "push the {object} forward",
        "push the {object} away from the robot",
        "move the {object} forward by pushing it",
    )


class Pull(Slide):
    """Pull the object back: 10 cm along −x, at most 5 cm sideways."""

    name = "pull"
    horizon = 60
    direction = -1.0
    object_area = ((0.0, -0.05), (0.06, 0.05))
    tcp_offset = ((-0.14, -0.07), (-0.07, 0.07))
    tcp_height = (0.08, 0.18)
    templates = (
        "pull the {object} back",
        "pull the {object} towards the robot",
        "move the {object} back by pulling it",
    )


LOWEST_UNDERSIDE: Final = -0.03
"""Least height of the underside of an object in a container (m), as computed for an upright object.
It is negative because an object that has fallen over reaches further down."""

LOWEST_RIM: Final = 0.02
"""Least rim height assumed for a container (m): an object need not lie perfectly flat on a plate."""


class PickPlace(Task):
    """Put the object into the container: its centre over the inner part, at rest, the gripper off it."""

    name = "pick_place"
    horizon = 110
    templates = (
        "put the {object} into the {container}",
        "pick up the {object} and place it in the {container}",
        "place the {object} on the {container}",
    )
    inner_share: ClassVar[float] = 0.7
    open_enough: ClassVar[float] = 0.6
    carry_height: ClassVar[float] = 0.08

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy = rng.uniform((-0.06, 0.0), (0.01, 0.07))
        offset = rng.uniform((-0.06, -0.07), (0.03, 0.05))
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=rng.uniform((-0.03, -0.17), (0.02, -0.13)),
            tcp=np.array([*(object_xy + offset), rng.uniform(0.11, 0.18)]),
            instruction=instruction,
            gripper_open=True,
        )

    def success(self, situation: Situation) -> bool:
        let_go = situation.gripper_opening >= self.open_enough
        return bool(self._inside(situation) and let_go and situation.object_speed <= REST_SPEED)

    def progress(self, situation: Situation) -> tuple[float, float]:
        """Return nearness of the TCP to the object, and progress.

        Lifting, carrying and lying inside the container are a third of the progress each.
        """
        reach = nearness(float(np.linalg.norm(situation.tcp - situation.object_now)))
        lifted = float(np.clip(situation.moved[2] / self.carry_height, 0.0, 1.0))
        way = np.linalg.norm(situation.start.container_xy - situation.object_start[:2])
        carried = float(np.clip(1.0 - self._away(situation) / way, 0.0, 1.0))
        inside = float(self._inside(situation))
        return reach, (max(lifted, inside) + carried * max(lifted, inside) + inside) / 3

    def _away(self, situation: Situation) -> float:
        """Return the horizontal distance from the object's centre to the container's (m)."""
        return float(np.linalg.norm(situation.start.container_xy - situation.object_now[:2]))

    def _inside(self, situation: Situation) -> bool:
        """Whether the object is over the inner part of the container, its underside below the rim."""
        underside = situation.object_now[2] - situation.spec.half_size[2]
        near = self._away(situation) <= self.inner_share * situation.container.radius
        return bool(near and LOWEST_UNDERSIDE < underside < max(situation.container.height, LOWEST_RIM))


class MoveToAim(Task):
    """Move the object onto the mat: its centre within 3 cm of the mat's, at rest on the table."""

    name = "move_to_aim"
    horizon = 60
    templates = (
        "move the {object} onto the blue mat",
        "slide the {object} to the blue mat",
        "bring the {object} to the mat without lifting it",
    )
    tolerance: ClassVar[float] = 0.03

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy = rng.uniform((-0.07, -0.03), (-0.02, 0.06))
        offset = rng.uniform((-0.07, -0.06), (0.03, 0.06))
        way, angle = rng.uniform(0.10, 0.14), rng.uniform(-0.4, 0.8)
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=scenery_place(rng),
            tcp=np.array([*(object_xy + offset), rng.uniform(0.11, 0.18)]),
            instruction=instruction,
            gripper_open=True,
            carpet_xy=object_xy + way * np.array([np.cos(angle), np.sin(angle)]),
        )

    def success(self, situation: Situation) -> bool:
        near = _to_mat(situation, situation.object_now) <= self.tolerance
        return bool(near and situation.on_table and situation.object_speed <= REST_SPEED)

    def progress(self, situation: Situation) -> tuple[float, float]:
        """Return nearness of the TCP to the object, and the share of the distance to the mat."""
        left, whole = (_to_mat(situation, place) for place in (situation.object_now, situation.object_start))
        reach = nearness(float(np.linalg.norm(situation.tcp - situation.object_now)))
        return reach, float(np.clip(1.0 - left / whole, 0.0, 1.0) * situation.on_table)


def _to_mat(situation: Situation, place: np.ndarray) -> float:
    """Return the horizontal distance from `place` (3,) to the mat's centre (m)."""
    assert situation.start.carpet_xy is not None
    return float(np.linalg.norm(situation.start.carpet_xy - place[:2]))


TASKS: Final[dict[str, Task]] = {task.name: task for task in (Push(), Pull(), PickPlace(), MoveToAim())}
"""Name → task."""


def tasks_of(names: str | None) -> tuple[Task, ...]:
    """Return the tasks of "push" or "push,pull". FieldError if one is unknown or named twice."""
    tasks = tuple(task_of(name.strip()) for name in str(names).split(","))
    if len({*tasks}) < len(tasks):
        raise FieldError("task", names, "names a task twice", "name each task once")
    return tasks


def task_of(name: str | None) -> Task:
    """Return the task called `name`. Raises FieldError if there is none."""
    if name not in TASKS:
        raise FieldError("task", name, f"unknown; choose one of {', '.join(TASKS)}")
    return TASKS[name]
