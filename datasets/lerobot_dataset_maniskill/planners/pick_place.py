"""Plans for pick_place: grasp, up, over the container, down, open, up."""

from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import OPEN, Waypoint
from lerobot_dataset_maniskill.planners.grasp import OPENING_STEPS, GraspPlanner, over
from lerobot_dataset_maniskill.planners.kinds import Waypoints

CARRY: Final = 0.06
"""Between the carried object's underside and the container's rim (m)."""

DROP: Final = 0.015
"""The same when the gripper opens."""


class PickPlacePlanner(GraspPlanner):
    """Carries the object high enough for the rim."""

    @property
    def target(self) -> np.ndarray:
        return self.start.container_xy

    def deliver(self, target: np.ndarray) -> Waypoints:
        carry, drop = (self.container.height + gap + self.grasp_height for gap in (CARRY, DROP))
        return (
            Waypoint(over(self.start.object_xy, carry), 0.025),
            Waypoint(over(target, carry), 0.012),
            Waypoint(over(target, drop), 0.010),
            Waypoint(over(target, drop), 0.02, OPEN, dwell=OPENING_STEPS),
            Waypoint(over(target, carry + 0.03), 0.02, OPEN),
        )

    @property
    def margins(self) -> tuple[float, float]:
        return self.container.radius - 0.01, self.container.radius + 0.06
