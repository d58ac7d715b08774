"""Plans for push and pull: go behind the object, then along x, further than success requires."""

from collections.abc import Callable
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import Waypoint, Waypoints, above_table
from lerobot_dataset_maniskill.planners.kinds import FINGER_HALF_THICKNESS, TaskPlanner
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.tasks import Pull, Push, Slide, Start

MARGIN: Final = 0.04
"""How much further than success requires a good slide goes (m), so that an SFT policy does not stop just
short."""

BEHIND: Final = 0.025
"""Gap between the gripper and the object before they touch (m)."""

CLEARANCE: Final = 0.035
"""Height of the fingertips above the object's top when the gripper passes over it (m)."""

MAX_DETOUR_X: Final = 0.16
"""Largest x of a detour (m): beyond it the arm is stretched out and gets no further."""


class SlidePlanner(TaskPlanner):
    """Plans a push, or a pull (`over_it`: the gripper passes over the object to its far side first)."""

    task: type[Slide]
    over_it: bool

    def __init__(self, spec: ObjectSpec, container: ContainerSpec, start: Start) -> None:
        super().__init__(spec, container, start)
        self.height = max(spec.half_size[2], 0.02)
        self.reach = spec.half_size[0] + FINGER_HALF_THICKNESS
        self.edge = spec.half_size[1] + FINGER_HALF_THICKNESS

    def at(self, forward: float, sideways: float = 0.0, height: float | None = None) -> np.ndarray:
        """Return the TCP position (3,) at which the touching gripper has slid the object by `forward` (m)."""
        x, y = self.start.object_xy
        z = self.height if height is None else height
        return above_table(np.array([x + self.task.direction * (forward - self.reach), y + sideways, z]))

    def approach(self, sideways: float = 0.0, height: float | None = None) -> Waypoints:
        """Return waypoints to the place behind the object."""
        behind = Waypoint(self.at(-BEHIND, sideways, height), 0.016, clear=True)
        if not self.over_it:
            return (behind,)
        clear = 2.0 * self.spec.half_size[2] + CLEARANCE
        above = self.at(-BEHIND, sideways, max(clear, behind.position[2]))
        return (Waypoint(above, 0.02, clear=True), behind)

    def essential(self) -> Waypoints:
        return (*self.approach(), Waypoint(self.at(self.task.distance + MARGIN), 0.006))

    def detour(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a position (3,) behind the object or beside that place; for a pull, above it."""
        lowest = 2.0 * self.spec.half_size[2] + CLEARANCE if self.over_it else 0.02
        place = self.at(
            rng.uniform(-0.14, -0.03), rng.uniform(-0.10, 0.10), rng.uniform(lowest, max(0.17, lowest))
        )
        return np.minimum(place, (MAX_DETOUR_X, np.inf, np.inf))

    def near_miss(self, rng: np.random.Generator) -> Waypoints:
        """Draw one of `NEAR_MISSES`, then rest or leave."""
        miss = NEAR_MISSES[int(rng.integers(len(NEAR_MISSES)))](self, rng)
        if rng.random() < 0.5:
            return miss
        away = self.at(rng.uniform(-0.08, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(0.03, 0.16))
        return (*miss, Waypoint(away, 0.02))


class PushPlanner(SlidePlanner):
    task, over_it = Push, False


class PullPlanner(SlidePlanner):
    task, over_it = Pull, True


def pass_over(slide: SlidePlanner, rng: np.random.Generator) -> Waypoints:
    """Pass over the object, from scraping its top to well above it, with a slide's path in x and y."""
    height = 2.0 * slide.spec.half_size[2] + rng.choice([rng.uniform(-0.008, 0.012), rng.uniform(0.01, 0.05)])
    sideways = rng.normal(0.0, 0.012)
    far = slide.task.distance + rng.uniform(-0.02, 0.03)
    return (*slide.approach(sideways, height), Waypoint(slide.at(far, sideways, height)))


def pass_beside(slide: SlidePlanner, rng: np.random.Generator) -> Waypoints:
    """Pass beside the object, from a grazing contact that turns it to a clear miss, at any height."""
    sideways = rng.choice((-1.0, 1.0)) * (slide.edge + rng.uniform(-0.015, 0.045))
    height = slide.height + rng.choice([rng.uniform(-0.01, 0.015), rng.uniform(0.0, 0.08)])
    far = slide.task.distance + rng.uniform(-0.02, MARGIN)
    return (*slide.approach(sideways, height), Waypoint(slide.at(far, sideways, height)))


def slide_off_centre(slide: SlidePlanner, rng: np.random.Generator) -> Waypoints:
    """Push straight, anywhere along the object's back, then rest: near the edge the object turns and slips
    off.

    A policy that has nearly learnt the task fails like this, so the world model must know such failures.
    """
    sideways = rng.uniform(-1.0, 1.0) * slide.edge
    end = slide.at(slide.task.distance + rng.uniform(-0.03, MARGIN), sideways)
    return (*slide.approach(sideways), Waypoint(end, 0.001))


def stop_short(slide: SlidePlanner, rng: np.random.Generator) -> Waypoints:
    """Stop just before contact; half of the time wait there, as the tolerance is too small to be met."""
    stop = slide.at(-rng.uniform(0.002, 0.04), rng.normal(0.0, 0.01))
    last = Waypoint(stop, 0.001 if rng.random() < 0.5 else 0.012)
    return (*slide.approach()[:-1], last)


def slide_partly(slide: SlidePlanner, rng: np.random.Generator) -> Waypoints:
    """Slide well, but end 1 to 5 cm before success."""
    end = slide.at(rng.uniform(0.05, 0.09))
    return (*slide.approach(), Waypoint(end, 0.001 if rng.random() < 0.5 else 0.008))


def slide_diagonally(slide: SlidePlanner, rng: np.random.Generator) -> Waypoints:
    """Slide far enough, but at least 5 cm to one side."""
    side = rng.choice((-1.0, 1.0))
    end = slide.at(slide.task.distance + 0.01, side * rng.uniform(0.05, 0.10))
    return (*slide.approach(-side * rng.uniform(0.0, 0.015)), Waypoint(end))


NearMiss = Callable[[SlidePlanner, np.random.Generator], Waypoints]
NEAR_MISSES: Final[tuple[NearMiss, ...]] = (
    pass_over,
    stop_short,
    slide_partly,
    slide_diagonally,
    *3 * (pass_beside,),
    *3 * (slide_off_centre,),
)
