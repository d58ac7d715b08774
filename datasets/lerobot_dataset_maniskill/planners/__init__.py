"""Scripted planners, one per task, and the motions between their waypoints."""

from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import MOTIONS, Follower, Motion, Plan, straight_lines
from lerobot_dataset_maniskill.planners.grasp import MoveToAimPlanner, PickPlacePlanner
from lerobot_dataset_maniskill.planners.kinds import TASK_KINDS, Planner
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
    """Return the follower of a new plan for an episode.

    Args:
        task: name of the task.
        scene: what is on the table.
        start: how the episode starts.
        kind: of the plan, `constants.KINDS` without "policy".
        rng: source of the plan's and the actions' randomness.
        motion: how the gripper gets from one waypoint to the next.
    """
    setting = OBJECTS[scene.object], CONTAINERS[scene.container], start
    plan = PLANNERS[task](*setting).plan(kind, rng)
    return Follower(motion(plan, *setting), rng)
