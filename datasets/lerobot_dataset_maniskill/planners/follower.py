"""Plans, and the proportional delta actions that follow them. Pure numpy."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.maniskill.episode import WORKSPACE_FLOOR

GAIN: Final = 2.0
"""Commanded delta over remaining distance; the arm achieves about a third of a command in one step."""

TOP_SPEED: Final = ACTION_HIGH[0]
OPTIMAL_SPEED: Final = 0.8 * TOP_SPEED
CLOSED: Final = -1.0
OPEN: Final = 1.0

Aim = Callable[[np.ndarray], np.ndarray]
"""Where to go, given where the object is: (3,) → (3,)"""


@dataclass(frozen=True)
class Waypoint:
    """A TCP position (3,) (m) that counts as reached within `tolerance` (m).

    Args:
        gripper: commanded all the way there.
        dwell: steps to stay once there, for the fingers to close or open.
        aim: replaces `position` by one that depends on the object's present place; never reached.
        patience: steps after which it is given up.
        clear: whether the way there is to keep clear of the object.
    """

    position: np.ndarray
    tolerance: float = 0.012
    gripper: float = CLOSED
    dwell: int = 0
    aim: Aim | None = None
    patience: int | None = None
    clear: bool = False


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
        self.plan, self.rng = plan, rng
        self.current, self.stayed, self.tried = 0, 0, 0

    def act(self, tcp: np.ndarray, thing: np.ndarray) -> np.ndarray:
        """The action (7,) float32 for the TCP at `tcp` and the object at `thing`, (3,) each, in the box."""
        waypoint = self._advance(tcp)
        target = waypoint.position if waypoint.aim is None else waypoint.aim(thing)
        delta = GAIN * (target - tcp)
        delta *= min(1.0, self.plan.speed / max(np.abs(delta).max(), 1e-9))
        action = np.array([*delta, 0.0, 0.0, 0.0, waypoint.gripper])
        noise = self.plan.noise
        action[:3] += self.rng.normal(0.0, 1.0, 3) * noise.position
        action[3:6] += self.rng.normal(0.0, 1.0, 3) * noise.rotation
        action[6] -= np.sign(waypoint.gripper) * abs(self.rng.normal(0.0, 1.0)) * noise.gripper
        return np.clip(action, ACTION_LOW, ACTION_HIGH).astype(np.float32)

    def _advance(self, tcp: np.ndarray) -> Waypoint:
        """The waypoint to go to now: the next one once this was reached and stayed at, or given up."""
        waypoints = self.plan.waypoints
        while self.current < len(waypoints) - 1 and not self._stays(waypoints[self.current], tcp):
            self.current, self.stayed, self.tried = self.current + 1, 0, 0
        self.tried += 1
        return waypoints[self.current]

    def _stays(self, waypoint: Waypoint, tcp: np.ndarray) -> bool:
        """Whether there is still something to do there."""
        if waypoint.patience is not None and self.tried >= waypoint.patience:
            return False
        if not _reached(waypoint, tcp):
            return True
        self.stayed += 1
        return self.stayed <= waypoint.dwell


def _reached(waypoint: Waypoint, tcp: np.ndarray) -> bool:
    return waypoint.aim is None and bool(np.linalg.norm(waypoint.position - tcp) < waypoint.tolerance)


def above_table(position: np.ndarray) -> np.ndarray:
    """The same position, not lower than the simulator lets the TCP go. (3,) → (3,)"""
    return np.array([position[0], position[1], max(position[2], WORKSPACE_FLOOR)])
