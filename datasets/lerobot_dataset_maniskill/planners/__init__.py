"""Scripted Cartesian planners, one a task."""

from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import Follower, Plan
from lerobot_dataset_maniskill.planners.kinds import TASK_KINDS, Planner
from lerobot_dataset_maniskill.planners.move_to_aim import MoveToAimPlanner
from lerobot_dataset_maniskill.planners.pick_place import PickPlacePlanner
from lerobot_dataset_maniskill.planners.slide import PullPlanner, PushPlanner
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Start

__all__ = ["PLANNERS", "TASK_KINDS", "Follower", "Plan", "Planner", "follow_plan"]

PLANNERS: Final[dict[str, type[Planner]]] = {
    "push": PushPlanner, "pull": PullPlanner, "pick_place": PickPlacePlanner, "move_to_aim": MoveToAimPlanner,
}  # fmt: skip
"""Task → planner."""


def follow_plan(task: str, scene: Scene, start: Start, kind: str, rng: np.random.Generator) -> Follower:
    """What steers an episode of the given kind (`constants.KINDS` without "policy") from its start."""
    planner = PLANNERS[task](OBJECTS[scene.object], CONTAINERS[scene.container], start)
    return Follower(planner.plan(kind, rng), rng)
