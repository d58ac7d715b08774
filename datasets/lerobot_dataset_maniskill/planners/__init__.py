"""Scripted planners, one a task, and the motions that lead from one of their waypoints to the next."""

from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import Follower, Plan
from lerobot_dataset_maniskill.planners.kinds import TASK_KINDS, Planner
from lerobot_dataset_maniskill.planners.motion import MOTIONS, Motion, straight_lines
from lerobot_dataset_maniskill.planners.move_to_aim import MoveToAimPlanner
from lerobot_dataset_maniskill.planners.pick_place import PickPlacePlanner
from lerobot_dataset_maniskill.planners.slide import PullPlanner, PushPlanner
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Start

__all__ = ["MOTIONS", "PLANNERS", "TASK_KINDS", "Follower", "Motion", "Plan", "Planner", "follow_plan"]

PLANNERS: Final[dict[str, type[Planner]]] = {
    "push": PushPlanner, "pull": PullPlanner, "pick_place": PickPlacePlanner, "move_to_aim": MoveToAimPlanner,
}  # fmt: skip
"""Task → planner."""


def follow_plan(
    task: str,
    scene: Scene,
    start: Start,
    kind: str,
    rng: np.random.Generator,
    motion: Motion = straight_lines,
) -> Follower:
    """What steers an episode of the given kind (`constants.KINDS` without "policy") from its start."""
    things = OBJECTS[scene.object], CONTAINERS[scene.container], start
    plan = PLANNERS[task](*things).plan(kind, rng)
    return Follower(motion(plan, *things), rng)
