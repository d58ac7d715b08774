"""Scripted planners, one per task, and the motions between their waypoints."""

from collections.abc import Callable
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import Follower, Plan
from lerobot_dataset_maniskill.planners.grasp import MoveToAimPlanner, PickPlacePlanner
from lerobot_dataset_maniskill.planners.kinds import TASK_KINDS, TaskPlanner
from lerobot_dataset_maniskill.planners.slide import PullPlanner, PushPlanner
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Start

__all__ = ["MOTIONS", "PLANNERS", "TASK_KINDS", "Follower", "Motion", "Plan", "TaskPlanner", "follow_plan"]

PLANNERS: Final[dict[str, type[TaskPlanner]]] = {
    "push": PushPlanner,
    "pull": PullPlanner,
    "pick_place": PickPlacePlanner,
    "move_to_aim": MoveToAimPlanner,
}
"""Task → planner."""


Motion = Callable[[Plan, ObjectSpec, ContainerSpec, Start], Plan]
"""Inserts points between a plan's waypoints, which stay as they are."""


def straight_lines(plan: Plan, spec: ObjectSpec, container: ContainerSpec, start: Start) -> Plan:
    """Return the plan as it is: the follower goes straight by itself."""
    return plan


def joint_space_motion() -> Motion:
    """Return the motion that MPLib plans in joint space, around what stands on the table."""
    from lerobot_dataset_maniskill.planners.joint_space import JointSpaceMotion  # needs MPLib

    return JointSpaceMotion()


MOTIONS: Final[dict[str, Callable[[], Motion]]] = {
    "cartesian": lambda: straight_lines,
    "mplib": joint_space_motion,
}
"""Value of the recorder's setting `planner` → what makes its motion."""


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
        kind: kind of the plan, `constants.KINDS` without "policy".
        rng: source of the plan's and the actions' randomness.
        motion: how the gripper gets from one waypoint to the next.
    """
    setting = scene.object_spec, scene.container_spec, start
    plan = PLANNERS[task](*setting).plan(kind, rng)
    return Follower(motion(plan, *setting), rng)
