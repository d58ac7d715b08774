"""Plans for move_to_aim: grasp, and slide the object over the table onto the mat."""

import numpy as np

from lerobot_dataset_maniskill.planners.follower import Waypoint
from lerobot_dataset_maniskill.planners.grasp import GraspPlanner, over
from lerobot_dataset_maniskill.planners.kinds import Waypoints
from lerobot_wmrl.maniskill.tasks import MoveToAim


class MoveToAimPlanner(GraspPlanner):
    """Holds the object on the table all the way: pushed at an angle, most things slip off the fingers."""

    @property
    def target(self) -> np.ndarray:
        assert self.start.carpet_xy is not None
        return self.start.carpet_xy

    def deliver(self, target: np.ndarray) -> Waypoints:
        return (Waypoint(over(target, self.grasp_height), 0.001),)

    @property
    def margins(self) -> tuple[float, float]:
        return MoveToAim.tolerance, MoveToAim.tolerance + 0.05
