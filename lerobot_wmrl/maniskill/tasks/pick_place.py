"""Pick and place: the object is to lie in the container, let go."""

from typing import ClassVar

import numpy as np

from lerobot_wmrl.maniskill.tasks.base import REST_SPEED, Situation, Start, Task, nearness

LOWEST = -0.03
"""An object that has fallen over reaches down so far below where its underside would be upright (m)."""

LOWEST_RIM = 0.02
"""What lies on a plate need not lie perfectly flat (m)."""


class PickPlace(Task):
    """Put the object into the container: its centre over the inner part, at rest, the gripper off it."""

    name = "pick_place"
    horizon = 110
    templates = (
        "put the {object} into the {container}",
        "pick up the {object} and place it in the {container}",
        "place the {object} on the {container}",
    )
    inner_share: ClassVar[float] = 0.7
    open_enough: ClassVar[float] = 0.6
    carry_height: ClassVar[float] = 0.08

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy = rng.uniform((-0.06, 0.0), (0.01, 0.07))
        offset = rng.uniform((-0.06, -0.07), (0.03, 0.05))
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=rng.uniform((-0.03, -0.17), (0.02, -0.13)),
            tcp=np.array([*(object_xy + offset), rng.uniform(0.11, 0.18)]),
            instruction=instruction,
            gripper_open=True,
        )

    def success(self, situation: Situation) -> bool:
        let_go = situation.gripper_opening >= self.open_enough
        return bool(self._inside(situation) and let_go and situation.object_speed <= REST_SPEED)

    def progress(self, situation: Situation) -> tuple[float, float]:
        """Nearness of the TCP to the object, and lifting, carrying, and lying inside, a third each."""
        reach = nearness(float(np.linalg.norm(situation.tcp - situation.object_now)))
        lifted = float(np.clip(situation.moved[2] / self.carry_height, 0.0, 1.0))
        way = np.linalg.norm(situation.start.container_xy - situation.object_start[:2])
        carried = float(np.clip(1.0 - self._away(situation) / way, 0.0, 1.0))
        inside = float(self._inside(situation))
        return reach, (max(lifted, inside) + carried * max(lifted, inside) + inside) / 3

    def _away(self, situation: Situation) -> float:
        """Horizontal distance from the object's centre to the container's (m)."""
        return float(np.linalg.norm(situation.start.container_xy - situation.object_now[:2]))

    def _inside(self, situation: Situation) -> bool:
        """Over the inner part of the container, its underside below the rim or on the plate."""
        underside = situation.object_now[2] - situation.spec.half_size[2]
        near = self._away(situation) <= self.inner_share * situation.container.radius
        return bool(near and LOWEST < underside < max(situation.container.height, LOWEST_RIM))
