"""The kinds of plans that every task has, from its essential waypoints: optimal, human-like, suboptimal, near
misses, play.

Suboptimal plans also get noise on their actions, so that the data contains what a stochastic policy does
around a good trajectory. Pure numpy."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import (
    CLOSED,
    OPEN,
    OPTIMAL_SPEED,
    TOP_SPEED,
    Aim,
    Noise,
    Plan,
    Waypoint,
    Waypoints,
    above_table,
)
from lerobot_wmrl.common.constants import HUMAN_LIKE, KINDS, PLAY
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.tasks import Start

FINGER_HALF_THICKNESS: Final = 0.011
"""Half of the closed fingertips' extent along x and y (m)."""

TASK_KINDS: Final = tuple(kind for kind in KINDS if kind not in ("policy", PLAY))
"""Kinds of plans that aim at the task, or just miss it."""

ROTATION_NOISE_KINDS: Final = ("waypoint", "noisy")
"""Kinds whose rotations and gripper commands are noisy too."""

CALM_SHARE: Final = {"waypoint": 0.3, "interpolated": 0.3, "noisy": 0.5, "near_miss": 0.6}
"""Share of each suboptimal kind whose actions have no noise, like those of optimal trajectories. If only good
episodes were calm, a world model would take calm actions for success, but an SFT policy is also calm when it
fails."""


DETOUR_SHARE: Final = 0.3
"""Share of human-like episodes that begin with a detour."""

CURVE_SHARE: Final = 0.5
"""Share of the ways between waypoints that are curved in human-like episodes."""

PAUSE_SHARE: Final = 0.35
"""Share of the waypoints at which a human-like episode pauses."""

PAUSE: Final = (2, 8)
"""Shortest pause in steps, and one more than the longest."""

TREMOR: Final = 0.003
"""Standard deviation of the noise on human-like actions (m)."""


class TaskPlanner(ABC):
    """Plans one episode of a task.

    Args:
        spec: the object to manipulate.
        container: the container on the table.
        start: how the episode starts.
    """

    def __init__(self, spec: ObjectSpec, container: ContainerSpec, start: Start) -> None:
        self.spec, self.container, self.start = spec, container, start

    @abstractmethod
    def essential(self) -> Waypoints:
        """Return the waypoints of an optimal trajectory."""

    @abstractmethod
    def detour(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a position (3,) away from the optimal trajectory, where the gripper touches nothing."""

    @abstractmethod
    def near_miss(self, rng: np.random.Generator) -> Waypoints:
        """Draw waypoints that miss success by little, or hardly reach it."""

    def plan(self, kind: str, rng: np.random.Generator) -> Plan:
        """Draw a plan of the given kind (`constants.KINDS` without "policy")."""
        if kind == "optimal":
            return Plan(self.essential(), speed=OPTIMAL_SPEED)
        if kind == PLAY:
            return Plan(play_waypoints(self.spec, rng), noise=Noise(rng.uniform(0.0, 0.01)))
        if kind == HUMAN_LIKE:
            return Plan(self.human_like(rng), noise=Noise(TREMOR))
        plan = Plan((), OPTIMAL_SPEED)
        if rng.random() >= CALM_SHARE[kind]:
            noise = Noise(rng.uniform(0.0, 0.015))
            if kind in ROTATION_NOISE_KINDS:
                noise = Noise(noise.position, rng.uniform(0.0, 0.05), rng.uniform(0.0, 0.3))
            plan = Plan((), rng.uniform(0.55, 1.0) * TOP_SPEED, noise)
        return replace(plan, waypoints=getattr(self, kind)(rng))

    def human_like(self, rng: np.random.Generator) -> Waypoints:
        """Draw how a person would teleoperate: uneven speed, pauses, curved ways, now and then a detour."""
        points: list[Waypoint] = []
        first, essential = self.start.tcp, jittered(self.essential(), rng, 0.004)
        if rng.random() < DETOUR_SHARE:
            points.append(Waypoint(self.detour(rng), 0.025, essential[0].gripper, clear=True))
            first = points[0].position
        for waypoint in essential:
            if rng.random() < CURVE_SHARE:
                between = (first + waypoint.position) / 2 + rng.normal(0.0, 0.012, 3)
                points.append(replace(waypoint, position=above_table(between), tolerance=0.02, dwell=0))
            pause = int(rng.integers(*PAUSE)) if rng.random() < PAUSE_SHARE else 0
            points.append(replace(waypoint, dwell=waypoint.dwell + pause))
            first = waypoint.position
        return tuple(replace(point, speed=rng.uniform(0.5, 1.0) * TOP_SPEED) for point in points)

    def waypoint(self, rng: np.random.Generator) -> Waypoints:
        """Draw a detour, then follow the essential waypoints."""
        essential = jittered(self.essential(), rng, 0.006)
        return (Waypoint(self.detour(rng), 0.025, essential[0].gripper, clear=True), *essential)

    def interpolated(self, rng: np.random.Generator) -> Waypoints:
        """Draw a point before each essential waypoint, moved off the straight line to it."""
        points: list[Waypoint] = []
        first = self.start.tcp
        for waypoint in self.essential():
            between = first + rng.uniform(0.3, 0.7) * (waypoint.position - first) + rng.normal(0.0, 0.013, 3)
            points += [replace(waypoint, position=above_table(between), tolerance=0.02, dwell=0), waypoint]
            first = waypoint.position
        return tuple(points)

    def noisy(self, rng: np.random.Generator) -> Waypoints:
        """Displace the essential waypoints a little: some episodes fail because of it."""
        return jittered(self.essential(), rng, rng.uniform(0.008, 0.03))


def jittered(waypoints: Sequence[Waypoint], rng: np.random.Generator, sigma: float) -> Waypoints:
    """Return the waypoints with Gaussian noise of `sigma` metres on their positions, above the table."""
    return tuple(
        replace(waypoint, position=above_table(waypoint.position + rng.normal(0.0, sigma, 3)))
        for waypoint in waypoints
    )


PLAY_STEPS: Final = 320
"""Control steps of an episode of play."""

PLAY_AREA: Final = ((-0.10, -0.12), (0.10, 0.12))
"""Lowest and highest x and y of the goals of play (m): in view, and within reach."""

PLAY_GOALS: Final = 40
PUSH_GAP: Final = 0.03
"""Distance from the gripper to the object's side before a push in play (m)."""


def play_waypoints(spec: ObjectSpec, rng: np.random.Generator) -> Waypoints:
    """Draw goals of play: go somewhere, push the object somewhere, or try to lift it.

    No task is meant to succeed, and nothing is reset in between, which gives long rollouts.
    """
    forms = (wander, push_somewhere, lift)
    chosen = rng.choice(len(forms), PLAY_GOALS, p=(0.35, 0.45, 0.2))
    return tuple(waypoint for form in chosen for waypoint in forms[form](spec, rng))


def wander(spec: ObjectSpec, rng: np.random.Generator) -> Waypoints:
    """Go to a random place above the table."""
    place = np.array([*rng.uniform(*PLAY_AREA), rng.uniform(0.02, 0.18)])
    return (Waypoint(place, 0.03, CLOSED if rng.random() < 0.7 else OPEN, patience=20),)


def push_somewhere(spec: ObjectSpec, rng: np.random.Generator) -> Waypoints:
    """Push the object towards a random place: over it, down behind it, then forward."""
    goal, height = rng.uniform(*PLAY_AREA), max(spec.half_size[2], 0.02)
    reach = max(spec.half_size[:2]) + PUSH_GAP

    def behind(up: float, ahead: float) -> Aim:
        def aim(object_now: np.ndarray) -> np.ndarray:
            offset = goal - object_now[:2]
            direction = offset / max(float(np.linalg.norm(offset)), 1e-3)
            x, y = np.clip(object_now[:2] + (ahead - reach) * direction, *PLAY_AREA)
            return above_table(np.array([x, y, up]))

        return aim

    high = 2 * spec.half_size[2] + 0.04
    steps = ((high, 0.0, 14), (height, 0.0, 8), (height, reach, int(rng.integers(6, 18))))
    unused = np.array([*goal, height])
    return tuple(Waypoint(unused, aim=behind(up, ahead), patience=patience) for up, ahead, patience in steps)


def lift(spec: ObjectSpec, rng: np.random.Generator) -> Waypoints:
    """Grasp the object where it is now, carry it a little, and let it go."""
    side = rng.normal(0.0, 0.006, 2)

    def above(up: float) -> Aim:
        return lambda object_now: above_table(np.array([*(np.clip(object_now[:2], *PLAY_AREA) + side), up]))

    low, high = max(spec.half_size[2], 0.016), 2 * spec.half_size[2] + 0.05
    goal = np.array([*rng.uniform(*PLAY_AREA), rng.uniform(0.05, 0.12)])
    down = np.array([*goal[:2], low])
    return (
        Waypoint(goal, aim=above(high), gripper=OPEN, patience=14),
        Waypoint(goal, aim=above(low), gripper=OPEN, patience=8),
        Waypoint(goal, aim=above(low), gripper=CLOSED, patience=6),
        Waypoint(goal, 0.02, patience=14),
        Waypoint(down, 0.01, patience=8),
        Waypoint(down, 0.02, OPEN, dwell=4, patience=8),
    )
