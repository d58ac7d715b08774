"""Scripted Cartesian planners: waypoints, and proportional delta actions that follow them. Pure numpy.

Optimal trajectories have only the waypoints the task needs. Suboptimal ones (method: waypoint, interpolated,
disturbed, and deliberate near misses) also get noise on every action, so that what a stochastic policy does
around a good trajectory is in the data as well.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final

import numpy as np

from lerobot_wmrl.constants import ACTION_HIGH, ACTION_LOW, WORKSPACE_FLOOR
from lerobot_wmrl.maniskill.objects import ObjectSpec
from lerobot_wmrl.maniskill.tasks import Push, Start

FINGER_HALF_THICKNESS: Final = 0.011
"""Half of the closed fingertips' extent along x and y (m)."""

GAIN: Final = 2.0
"""Commanded delta over remaining distance; the arm achieves about a third of a command in one step."""

TOP_SPEED: Final = ACTION_HIGH[0]
OPTIMAL_SPEED: Final = 0.8 * TOP_SPEED
CLOSED: Final = -1.0
TURNED: Final = ("waypoint", "disturbed")
"""Kinds whose rotations and gripper commands are disturbed too."""

CALM_SHARE: Final = {"waypoint": 0.3, "interpolated": 0.3, "disturbed": 0.5, "near_miss": 0.6}
"""Share of each suboptimal kind that moves as evenly as the optimal trajectories do. If only good episodes
were calm, a world model would take calm actions for success: a cloned policy is calm when it fails, too."""

MARGIN: Final = 0.04
"""How much further than success demands a good push aims (m), so that a cloned policy stops no hair early."""


@dataclass(frozen=True)
class Waypoint:
    """A TCP position (3,) (m) that counts as reached within `tolerance` (m)."""

    position: np.ndarray
    tolerance: float = 0.012


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is added to every action: metres, radians, gripper units."""

    position: float = 0.0
    rotation: float = 0.0
    gripper: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Waypoints in order, the largest command along an axis (m), and the noise on actions."""

    waypoints: tuple[Waypoint, ...]
    speed: float = TOP_SPEED
    noise: Noise = field(default_factory=Noise)


class Follower:
    """Turns a plan into actions, one a control step."""

    def __init__(self, plan: Plan, rng: np.random.Generator) -> None:
        self.plan, self.rng, self.current = plan, rng, 0

    def act(self, tcp: np.ndarray) -> np.ndarray:
        """The action (7,) float32 for the TCP at `tcp` (3,): towards the current waypoint, inside the box."""
        waypoints = self.plan.waypoints
        while self.current < len(waypoints) - 1 and _reached(waypoints[self.current], tcp):
            self.current += 1
        delta = GAIN * (waypoints[self.current].position - tcp)
        delta *= min(1.0, self.plan.speed / max(np.abs(delta).max(), 1e-9))
        action = np.array([*delta, 0.0, 0.0, 0.0, CLOSED])
        noise = self.plan.noise
        action[:3] += self.rng.normal(0.0, 1.0, 3) * noise.position
        action[3:6] += self.rng.normal(0.0, 1.0, 3) * noise.rotation
        action[6] += abs(self.rng.normal(0.0, 1.0)) * noise.gripper
        return np.clip(action, ACTION_LOW, ACTION_HIGH).astype(np.float32)


def _reached(waypoint: Waypoint, tcp: np.ndarray) -> bool:
    return bool(np.linalg.norm(waypoint.position - tcp) < waypoint.tolerance)


@dataclass(frozen=True)
class PushGeometry:
    """Where a push happens: the object's spec and start, and what follows from them."""

    spec: ObjectSpec
    start: Start

    @property
    def height(self) -> float:
        """Of the TCP while pushing: the middle of the object."""
        return max(self.spec.half_size[2], 0.02)

    @property
    def reach(self) -> float:
        """From the TCP to the object's centre at contact, along x."""
        return self.spec.half_size[0] + FINGER_HALF_THICKNESS

    def at(self, forward: float, sideways: float = 0.0, height: float | None = None) -> np.ndarray:
        """TCP position such that, touching, the object has moved by `forward` from its start."""
        x, y = self.start.object_xy
        z = self.height if height is None else height
        return np.array([x + forward - self.reach, y + sideways, max(z, WORKSPACE_FLOOR)])


def essential_push(geometry: PushGeometry) -> tuple[Waypoint, ...]:
    """Behind the object, then forward, further than need be."""
    return (Waypoint(geometry.at(-0.025), 0.016), Waypoint(geometry.at(Push.distance + MARGIN), 0.006))


def plan_push(kind: str, spec: ObjectSpec, start: Start, rng: np.random.Generator) -> Plan:
    """A plan of the given kind (`constants.KINDS` without "policy") for an episode of push."""
    geometry = PushGeometry(spec, start)
    if kind == "optimal":
        return Plan(essential_push(geometry), speed=OPTIMAL_SPEED)
    plan = Plan((), OPTIMAL_SPEED)
    if rng.random() >= CALM_SHARE[kind]:
        noise = Noise(rng.uniform(0.0, 0.015))
        if kind in TURNED:
            noise = Noise(noise.position, rng.uniform(0.0, 0.05), rng.uniform(0.0, 0.3))
        plan = Plan((), rng.uniform(0.55, 1.0) * TOP_SPEED, noise)
    return replace(plan, waypoints=SUBOPTIMAL[kind](geometry, rng))


def waypoint_push(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """An unrelated waypoint first, behind or beside the object, then the essential ones."""
    detour = geometry.at(rng.uniform(-0.14, -0.03), rng.uniform(-0.10, 0.10), rng.uniform(0.02, 0.17))
    return (Waypoint(detour, 0.025), *_jittered(essential_push(geometry), rng, 0.006))


def interpolated_push(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """New points between the start and the essential waypoints, each moved off the straight line."""
    corners = [geometry.start.tcp, *(waypoint.position for waypoint in essential_push(geometry))]
    points: list[Waypoint] = []
    for first, second in pairwise(corners):
        share = rng.uniform(0.3, 0.7)
        between = first + share * (second - first) + rng.normal(0.0, 0.013, 3)
        points += [Waypoint(_above_table(between), 0.02), Waypoint(second, 0.016)]
    return tuple(points)


def disturbed_push(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """The essential waypoints, each a little off: some pushes slip, turn the object or pass over it."""
    return _jittered(essential_push(geometry), rng, rng.uniform(0.008, 0.03))


def near_miss_push(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Nearly a push: over, beside, short of, not far enough, or too much to one side; then rest or leave."""
    miss = NEAR_MISSES[int(rng.integers(len(NEAR_MISSES)))](geometry, rng)
    if rng.random() < 0.5:
        return miss
    afterwards = geometry.at(rng.uniform(-0.08, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(0.03, 0.16))
    return (*miss, Waypoint(afterwards, 0.02))


def pass_over(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Over the object: from scraping its top to well above it, with a push's path in x and y."""
    height = 2.0 * geometry.spec.half_size[2] + rng.choice(
        [rng.uniform(-0.008, 0.012), rng.uniform(0.01, 0.05)]
    )
    sideways = rng.normal(0.0, 0.012)
    far = Push.distance + rng.uniform(-0.02, 0.03)
    return (
        Waypoint(geometry.at(-0.025, sideways, height), 0.014),
        Waypoint(geometry.at(far, sideways, height)),
    )


def pass_beside(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Past the object's side: from a grazing contact that turns it to a clear miss, at any height."""
    edge = geometry.spec.half_size[1] + FINGER_HALF_THICKNESS
    sideways = rng.choice((-1.0, 1.0)) * (edge + rng.uniform(-0.015, 0.045))
    height = geometry.height + rng.choice([rng.uniform(-0.01, 0.015), rng.uniform(0.0, 0.08)])
    far = Push.distance + rng.uniform(-0.02, MARGIN)
    return (
        Waypoint(geometry.at(-0.025, sideways, height), 0.014),
        Waypoint(geometry.at(far, sideways, height)),
    )


def push_off_centre(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """A straight push anywhere along the object's back, then a rest: near the edge it turns and slips off.

    This is how a policy fails that has nearly learnt the task, and the world model must not believe it.
    """
    sideways = rng.uniform(-1.0, 1.0) * (geometry.spec.half_size[1] + FINGER_HALF_THICKNESS)
    behind = Waypoint(geometry.at(-0.025, sideways), 0.016)
    return (behind, Waypoint(geometry.at(Push.distance + rng.uniform(-0.03, MARGIN), sideways), 0.001))


def stop_short(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Stops just before contact and stays a while (a tolerance that is never met)."""
    stop = geometry.at(-rng.uniform(0.002, 0.04), rng.normal(0.0, 0.01))
    return (Waypoint(stop, 0.001 if rng.random() < 0.5 else 0.012),)


def push_partly(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """A good push that ends 1 to 5 cm before success, then rests or leaves."""
    behind, _ = essential_push(geometry)
    end = geometry.at(rng.uniform(0.05, 0.09))
    return (behind, Waypoint(end, 0.001 if rng.random() < 0.5 else 0.008))


def push_diagonally(geometry: PushGeometry, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Far enough forward, but at least 5 cm to one side."""
    side = rng.choice((-1.0, 1.0))
    behind = geometry.at(-0.02, -side * rng.uniform(0.0, 0.015))
    return (
        Waypoint(behind, 0.014),
        Waypoint(geometry.at(Push.distance + 0.01, side * rng.uniform(0.05, 0.10))),
    )


def _jittered(
    waypoints: tuple[Waypoint, ...], rng: np.random.Generator, sigma: float
) -> tuple[Waypoint, ...]:
    return tuple(replace(w, position=_above_table(w.position + rng.normal(0.0, sigma, 3))) for w in waypoints)


def _above_table(position: np.ndarray) -> np.ndarray:
    return np.array([position[0], position[1], max(position[2], WORKSPACE_FLOOR)])


Shaper = Callable[[PushGeometry, np.random.Generator], tuple[Waypoint, ...]]
SUBOPTIMAL: Final[dict[str, Shaper]] = {
    "waypoint": waypoint_push,
    "interpolated": interpolated_push,
    "disturbed": disturbed_push,
    "near_miss": near_miss_push,
}
NEAR_MISSES: Final[tuple[Shaper, ...]] = (
    pass_over, stop_short, push_partly, push_diagonally, *3 * (pass_beside,), *3 * (push_off_centre,),
)  # fmt: skip

PLANNERS: Final = {Push.name: plan_push}
"""Task → planner."""
