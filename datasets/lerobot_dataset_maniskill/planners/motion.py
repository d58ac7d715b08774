"""How the gripper gets from one waypoint to the next: in a straight line, or as a motion planner says."""

from collections.abc import Callable
from typing import Final

from lerobot_dataset_maniskill.planners.follower import Plan
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.tasks import Start

Motion = Callable[[Plan, ObjectSpec, ContainerSpec, Start], Plan]
"""Puts points on the way between a plan's waypoints, which stay what they are."""


def straight_lines(plan: Plan, spec: ObjectSpec, container: ContainerSpec, start: Start) -> Plan:
    """The plan as it is: the follower goes straight by itself."""
    return plan


def cartesian() -> Motion:
    """From waypoint to waypoint in straight lines."""
    return straight_lines


def mplib() -> Motion:
    """Through joint space, around what stands on the table. Imports the library only when it is asked for."""
    from lerobot_dataset_maniskill.planners.joint_space.motion import JointSpaceMotion

    return JointSpaceMotion()


MOTIONS: Final[dict[str, Callable[[], Motion]]] = {"cartesian": cartesian, "mplib": mplib}
"""What `--planner` may be → what makes it."""
