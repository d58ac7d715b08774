"""Play: one goal after the other, without a reset, for long rollouts. No task is meant to succeed."""

from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import CLOSED, OPEN, Aim, Waypoint, above_table
from lerobot_wmrl.maniskill.objects import ObjectSpec

PLAY_STEPS: Final = 320
"""Length of an episode of play."""

AREA: Final = ((-0.10, -0.12), (0.10, 0.12))
"""Lowest and highest x and y of the goals (m): in view, and within reach."""

GOALS: Final = 40
GAP: Final = 0.03
"""From the gripper to the object's side before a push (m)."""


def play_waypoints(spec: ObjectSpec, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Random places, pushes of the object towards random places, and attempts to lift it."""
    forms = (wander, push_somewhere, lift)
    chosen = rng.choice(len(forms), GOALS, p=(0.35, 0.45, 0.2))
    return tuple(waypoint for form in chosen for waypoint in forms[form](spec, rng))


def wander(spec: ObjectSpec, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """To a random place above the table."""
    place = np.array([*rng.uniform(*AREA), rng.uniform(0.02, 0.18)])
    return (Waypoint(place, 0.03, CLOSED if rng.random() < 0.7 else OPEN, patience=20),)


def push_somewhere(spec: ObjectSpec, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Over the object to its far side as seen from a random place, down, and push it towards that place."""
    goal, height = rng.uniform(*AREA), max(spec.half_size[2], 0.02)
    reach = max(spec.half_size[:2]) + GAP

    def behind(up: float, ahead: float) -> Aim:
        def aim(thing: np.ndarray) -> np.ndarray:
            way = goal - thing[:2]
            along = way / max(float(np.linalg.norm(way)), 1e-3)
            x, y = np.clip(thing[:2] + (ahead - reach) * along, *AREA)
            return above_table(np.array([x, y, up]))

        return aim

    high = 2 * spec.half_size[2] + 0.04
    steps = ((high, 0.0, 14), (height, 0.0, 8), (height, reach, int(rng.integers(6, 18))))
    nowhere = np.array([*goal, height])
    return tuple(Waypoint(nowhere, aim=behind(up, ahead), patience=patience) for up, ahead, patience in steps)


def lift(spec: ObjectSpec, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Grasp the object where it is now, carry it a little, and let it go."""
    side = rng.normal(0.0, 0.006, 2)

    def above(up: float) -> Aim:
        return lambda thing: above_table(np.array([*(np.clip(thing[:2], *AREA) + side), up]))

    low, high = max(spec.half_size[2], 0.016), 2 * spec.half_size[2] + 0.05
    goal = np.array([*rng.uniform(*AREA), rng.uniform(0.05, 0.12)])
    down = np.array([*goal[:2], low])
    return (
        Waypoint(goal, aim=above(high), gripper=OPEN, patience=14),
        Waypoint(goal, aim=above(low), gripper=OPEN, patience=8),
        Waypoint(goal, aim=above(low), gripper=CLOSED, patience=6),
        Waypoint(goal, 0.02, patience=14),
        Waypoint(down, 0.01, patience=8),
        Waypoint(down, 0.02, OPEN, dwell=4, patience=8),
    )
