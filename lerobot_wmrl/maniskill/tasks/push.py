"""Push and pull: the object is to slide ten centimetres along x."""

from typing import ClassVar

import numpy as np

from lerobot_wmrl.maniskill.tasks.base import Situation, Start, Task, nearness, scenery_place

CONTACT_DISTANCE = 0.03
"""From the object's centre to the place behind it that the reward draws the gripper to (m)."""


Area = tuple[tuple[float, float], tuple[float, float]]
"""Lowest and highest (x, y), in metres."""


class Slide(Task):
    """The object is to move `distance` along `direction`·x, at most `lateral_limit` sideways.

    It starts in `object_area`, the TCP at an offset from it in `tcp_offset` and at a height in `tcp_height`.
    """

    direction: ClassVar[float]
    distance: ClassVar[float] = 0.10
    lateral_limit: ClassVar[float] = 0.05
    object_area: ClassVar[Area]
    tcp_offset: ClassVar[Area]
    tcp_height: ClassVar[tuple[float, float]]

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy, offset = rng.uniform(*self.object_area), rng.uniform(*self.tcp_offset)
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=scenery_place(rng),
            tcp=np.array([*(object_xy + offset), rng.uniform(*self.tcp_height)]),
            instruction=instruction,
        )

    def success(self, situation: Situation) -> bool:
        forward, sideways, _ = situation.moved
        far = self.direction * forward >= self.distance
        return bool(far and abs(sideways) <= self.lateral_limit and situation.on_table)

    def progress(self, situation: Situation) -> tuple[float, float]:
        """Nearness of the TCP to the place behind the object, and the share of the way, if not off it."""
        forward, sideways, _ = situation.moved
        behind = situation.object_now - np.array([self.direction * CONTACT_DISTANCE, 0.0, 0.0])
        share = np.clip(self.direction * forward / self.distance, 0.0, 1.0)
        reach = nearness(float(np.linalg.norm(situation.tcp - behind)))
        return reach, float(share * (abs(sideways) <= self.lateral_limit))


class Push(Slide):
    """Push the object forward: 10 cm along +x, at most 5 cm sideways."""

    name = "push"
    horizon = 40
    direction = 1.0
    object_area = ((-0.05, -0.05), (0.01, 0.05))
    tcp_offset = ((-0.16, -0.08), (-0.08, 0.08))
    tcp_height = (0.03, 0.16)
    templates = (
        "push the {object} forward",
        "push the {object} away from the robot",
        "move the {object} forward by pushing it",
    )


class Pull(Slide):
    """Pull the object back: 10 cm along −x, at most 5 cm sideways."""

    name = "pull"
    horizon = 60
    direction = -1.0
    object_area = ((0.0, -0.05), (0.06, 0.05))
    tcp_offset = ((-0.14, -0.07), (-0.07, 0.07))
    tcp_height = (0.08, 0.18)
    templates = (
        "pull the {object} back",
        "pull the {object} towards the robot",
        "move the {object} back by pulling it",
    )
