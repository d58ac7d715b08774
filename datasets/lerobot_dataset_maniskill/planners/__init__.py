"""Scripted Cartesian planners, one a task."""

from typing import Final

from lerobot_dataset_maniskill.planners.follower import Follower, Plan
from lerobot_dataset_maniskill.planners.kinds import Planner
from lerobot_dataset_maniskill.planners.move_to_aim import MoveToAimPlanner
from lerobot_dataset_maniskill.planners.pick_place import PickPlacePlanner
from lerobot_dataset_maniskill.planners.slide import PullPlanner, PushPlanner

__all__ = ["PLANNERS", "Follower", "Plan", "Planner"]

PLANNERS: Final[dict[str, type[Planner]]] = {
    "push": PushPlanner, "pull": PullPlanner, "pick_place": PickPlacePlanner, "move_to_aim": MoveToAimPlanner,
}  # fmt: skip
"""Task → planner."""
