"""From a task's essential waypoints to plans of every kind (method: optimal; waypoint, interpolated and
noisy; and deliberate near misses). Pure numpy.

Suboptimal plans also get noise on their actions, so that what a stochastic policy does around a good
trajectory is in the data as well.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import (
    OPTIMAL_SPEED,
    TOP_SPEED,
    Noise,
    Plan,
    Waypoint,
    above_table,
)
from lerobot_dataset_maniskill.planners.play import play_waypoints
from lerobot_wmrl.common.constants import KINDS, PLAY
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.tasks import Start

FINGER_HALF_THICKNESS: Final = 0.011
"""Half of the closed fingertips' extent along x and y (m)."""

TASK_KINDS: Final = tuple(kind for kind in KINDS if kind not in ("policy", PLAY))
"""Kinds of plan that have to do with the task."""

TURNED: Final = ("waypoint", "noisy")
"""Kinds whose rotations and gripper commands are noisy too."""

CALM_SHARE: Final = {"waypoint": 0.3, "interpolated": 0.3, "noisy": 0.5, "near_miss": 0.6}
"""Share of each suboptimal kind that moves as evenly as the optimal trajectories do. If only good episodes
were calm, a world model would take calm actions for success: a cloned policy is calm when it fails, too."""

Waypoints = tuple[Waypoint, ...]


class Planner(ABC):
    """Plans one episode of a task, from its start and what is on the table."""

    def __init__(self, spec: ObjectSpec, container: ContainerSpec, start: Start) -> None:
        self.spec, self.container, self.start = spec, container, start

    @abstractmethod
    def essential(self) -> Waypoints:
        """Only what the task needs."""

    @abstractmethod
    def detour(self, rng: np.random.Generator) -> np.ndarray:
        """An unrelated position on the way, where it harms nothing. (3,)"""

    @abstractmethod
    def near_miss(self, rng: np.random.Generator) -> Waypoints:
        """Nearly a success, but not one, or hardly."""

    def plan(self, kind: str, rng: np.random.Generator) -> Plan:
        """A plan of the given kind (`constants.KINDS` without "policy")."""
        if kind == "optimal":
            return Plan(self.essential(), speed=OPTIMAL_SPEED)
        if kind == PLAY:
            return Plan(play_waypoints(self.spec, rng), noise=Noise(rng.uniform(0.0, 0.01)))
        plan = Plan((), OPTIMAL_SPEED)
        if rng.random() >= CALM_SHARE[kind]:
            noise = Noise(rng.uniform(0.0, 0.015))
            if kind in TURNED:
                noise = Noise(noise.position, rng.uniform(0.0, 0.05), rng.uniform(0.0, 0.3))
            plan = Plan((), rng.uniform(0.55, 1.0) * TOP_SPEED, noise)
        return replace(plan, waypoints=getattr(self, kind)(rng))

    def waypoint(self, rng: np.random.Generator) -> Waypoints:
        """An unrelated waypoint first, then the essential ones."""
        essential = jittered(self.essential(), rng, 0.006)
        return (Waypoint(self.detour(rng), 0.025, essential[0].gripper, clear=True), *essential)

    def interpolated(self, rng: np.random.Generator) -> Waypoints:
        """New points between the start and the essential waypoints, each moved off the straight line."""
        points: list[Waypoint] = []
        first = self.start.tcp
        for waypoint in self.essential():
            between = first + rng.uniform(0.3, 0.7) * (waypoint.position - first) + rng.normal(0.0, 0.013, 3)
            points += [replace(waypoint, position=above_table(between), tolerance=0.02, dwell=0), waypoint]
            first = waypoint.position
        return tuple(points)

    def noisy(self, rng: np.random.Generator) -> Waypoints:
        """The essential waypoints, each a little off: some fail by it."""
        return jittered(self.essential(), rng, rng.uniform(0.008, 0.03))


def jittered(waypoints: Sequence[Waypoint], rng: np.random.Generator, sigma: float) -> Waypoints:
    """Every waypoint moved by Gaussian noise of `sigma` metres, not into the table."""

    return tuple(
        replace(waypoint, position=above_table(waypoint.position + rng.normal(0.0, sigma, 3)))
        for waypoint in waypoints
    )
