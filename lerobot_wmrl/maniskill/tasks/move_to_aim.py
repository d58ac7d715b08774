"""Move to aim: the object is to come to lie on the mat."""

from typing import ClassVar

import numpy as np

from lerobot_wmrl.maniskill.tasks.base import REST_SPEED, Situation, Start, Task, nearness, scenery_place


class MoveToAim(Task):
    """Move the object onto the mat: its centre within 3 cm of the mat's, at rest on the table."""

    name = "move_to_aim"
    horizon = 60
    templates = (
        "move the {object} onto the blue mat",
        "slide the {object} to the blue mat",
        "bring the {object} to the mat without lifting it",
    )
    tolerance: ClassVar[float] = 0.03

    def sample_start(self, rng: np.random.Generator, instruction: str) -> Start:
        object_xy = rng.uniform((-0.07, -0.03), (-0.02, 0.06))
        offset = rng.uniform((-0.07, -0.06), (0.03, 0.06))
        way, angle = rng.uniform(0.10, 0.14), rng.uniform(-0.4, 0.8)
        return Start(
            object_xy=object_xy,
            object_yaw=float(rng.uniform(-0.2, 0.2)),
            container_xy=scenery_place(rng),
            tcp=np.array([*(object_xy + offset), rng.uniform(0.11, 0.18)]),
            instruction=instruction,
            gripper_open=True,
            carpet_xy=object_xy + way * np.array([np.cos(angle), np.sin(angle)]),
        )

    def success(self, situation: Situation) -> bool:
        near = _left(situation, situation.object_now) <= self.tolerance
        return bool(near and situation.on_table and situation.object_speed <= REST_SPEED)

    def progress(self, situation: Situation) -> tuple[float, float]:
        """Nearness of the TCP to the object, and the share of the way."""
        left, way = (_left(situation, place) for place in (situation.object_now, situation.object_start))
        reach = nearness(float(np.linalg.norm(situation.tcp - situation.object_now)))
        return reach, float(np.clip(1.0 - left / way, 0.0, 1.0) * situation.on_table)


def _left(situation: Situation, place: np.ndarray) -> float:
    """From `place` (3,) to the mat's centre (m)."""
    assert situation.start.carpet_xy is not None
    return float(np.linalg.norm(situation.start.carpet_xy - place[:2]))
