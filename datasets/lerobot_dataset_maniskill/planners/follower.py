"""Plans, and the proportional actions that follow them. Pure numpy."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.maniskill.episode import WORKSPACE_FLOOR

GAIN: Final = 2.0
"""Commanded delta over remaining distance. The arm achieves about a third of a command in one step."""

TOP_SPEED: Final = ACTION_HIGH[0]
OPTIMAL_SPEED: Final = 0.8 * TOP_SPEED
CLOSED: Final = -1.0
OPEN: Final = 1.0

Aim = Callable[[np.ndarray], np.ndarray]
"""Maps the object's present position (3,) to the TCP position (3,) to go to."""


@dataclass(frozen=True)
class Waypoint:
    """A position that the gripper goes to.

    Args:
        position: position of the TCP (3,), metres.
        tolerance: distance (m) within which the waypoint counts as reached.
        gripper: gripper command on the way there.
        dwell: steps to stay once there, for the fingers to close or open.
        aim: replaces `position` by one that depends on where the object is now. Such a waypoint never counts
            as reached, so it needs `patience`.
        patience: steps after which the follower goes on to the next waypoint.
        speed: largest command along an axis (m) on the way there; by default the plan's.
        clear: whether a motion planner must keep the way there clear of the object.
    """

    position: np.ndarray
    tolerance: float = 0.012
    gripper: float = CLOSED
    dwell: int = 0
    aim: Aim | None = None
    patience: int | None = None
    speed: float | None = None
    clear: bool = False


Waypoints = tuple[Waypoint, ...]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the noise on every action: metres, radians, gripper units."""

    position: float = 0.0
    rotation: float = 0.0
    gripper: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Waypoints in order, the largest command along an axis (m), and the noise on actions."""

    waypoints: Waypoints
    speed: float = TOP_SPEED
    noise: Noise = field(default_factory=Noise)


class Follower:
    """Turns a plan into actions, one per control step."""

    def __init__(self, plan: Plan, rng: np.random.Generator) -> None:
        self.plan, self.rng = plan, rng
        self.current, self.stayed, self.tried = 0, 0, 0

    def act(self, tcp: np.ndarray, object_now: np.ndarray) -> np.ndarray:
        """Return the action for the TCP at `tcp` (3,) and the object at `object_now` (3,).

        Returns:
            (7,) float32, inside the action box.
        """
        waypoint = self._advance(tcp)
        target = waypoint.position if waypoint.aim is None else waypoint.aim(object_now)
        delta = GAIN * (target - tcp)
        delta *= min(1.0, (waypoint.speed or self.plan.speed) / max(np.abs(delta).max(), 1e-9))
        action = np.array([*delta, 0.0, 0.0, 0.0, waypoint.gripper])
        noise = self.plan.noise
        action[:3] += self.rng.normal(0.0, 1.0, 3) * noise.position
        action[3:6] += self.rng.normal(0.0, 1.0, 3) * noise.rotation
        action[6] -= np.sign(waypoint.gripper) * abs(self.rng.normal(0.0, 1.0)) * noise.gripper
        return np.clip(action, ACTION_LOW, ACTION_HIGH).astype(np.float32)

    def _advance(self, tcp: np.ndarray) -> Waypoint:
        """Return the waypoint to go to now: the next one once this one is done or given up."""
        waypoints = self.plan.waypoints
        while self.current < len(waypoints) - 1 and not self._is_pending(waypoints[self.current], tcp):
            self.current, self.stayed, self.tried = self.current + 1, 0, 0
        self.tried += 1
        return waypoints[self.current]

    def _is_pending(self, waypoint: Waypoint, tcp: np.ndarray) -> bool:
        """Whether the waypoint is not reached yet, or its dwell is not over."""
        if waypoint.patience is not None and self.tried >= waypoint.patience:
            return False
        if not _reached(waypoint, tcp):
            return True
        self.stayed += 1
        return self.stayed <= waypoint.dwell


def _reached(waypoint: Waypoint, tcp: np.ndarray) -> bool:
    return waypoint.aim is None and bool(np.linalg.norm(waypoint.position - tcp) < waypoint.tolerance)


def above_table(position: np.ndarray) -> np.ndarray:
    """Return the position (3,), raised to the lowest height that the simulator lets the TCP go to."""
    return np.array([position[0], position[1], max(position[2], WORKSPACE_FLOOR)])


def resample(path: np.ndarray, spacing: float) -> np.ndarray:
    """Return a polyline's evenly spread points, at most `spacing` apart, with both ends. (N, D) → (M, D)"""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    even = np.linspace(0.0, along[-1], max(int(np.ceil(along[-1] / spacing)), 1) + 1)
    return np.stack([np.interp(even, along, coordinate) for coordinate in path.T], axis=1)
