"""Motions between waypoints that MPLib plans in joint space, around what stands on the table."""

import logging
from dataclasses import replace
from typing import Final

import numpy as np

from lerobot_dataset_maniskill.planners.follower import OPEN, Plan, Waypoint, above_table, resample
from lerobot_dataset_maniskill.planners.planning_arm import PlanningArm
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.robot import GRIPPER_OPEN
from lerobot_wmrl.maniskill.tasks import Start

TABLE_SIZE: Final = (3.0, 3.0, 0.1)
TABLE_TOP: Final = -0.001
"""Height of the table in the planning world (m). The robot's base stands on it, and would collide at 0."""

MARGIN: Final = 0.01
"""Distance kept from the container and the object (m), because the follower cuts the corners of a path."""

POINT_SPACING: Final = 0.03
"""Distance between two points of a path (m)."""

POINT_TOLERANCE: Final = 0.018
POINT_PATIENCE: Final = 8
"""Steps after which a point of a path is given up. It takes 2 or 3, and nothing depends on it."""

CHECK_SPACING: Final = 0.01
"""Distance between the points of a straight line that are checked for collisions (m)."""


class JointSpaceMotion:
    """A `planners.Motion` that keeps off the table, the container and, until it must be touched, the object.

    A leg that must keep clear of the object (`Waypoint.clear`) is planned in joint space. The other legs
    push, grasp or carry the object: they stay straight lines where table and container permit, and are
    planned where not. A leg also stays a straight line if there is no path, as to a place inside the
    container, or if one of its ends depends on where the object will be."""

    def __init__(self) -> None:
        self.arm = PlanningArm()
        centre = np.array([0.0, 0.0, TABLE_TOP - TABLE_SIZE[2] / 2])
        self.arm.put_box("table", np.array(TABLE_SIZE), centre)

    def __call__(self, plan: Plan, spec: ObjectSpec, container: ContainerSpec, start: Start) -> Plan:
        self._put_container(container, start)
        place: np.ndarray | None = start.tcp
        waypoints: list[Waypoint] = []
        for waypoint in plan.waypoints:
            known = waypoint.aim is None
            if place is not None and known:
                self._put_object(spec, start, waypoint.clear)
                waypoints += self._points(place, waypoint)
            waypoints.append(waypoint)
            place = waypoint.position if known else None
        return replace(plan, waypoints=tuple(waypoints))

    def _put_container(self, container: ContainerSpec, start: Start) -> None:
        """Put the container into the planning world as a solid cylinder."""
        radius, height = container.radius + MARGIN, container.height + MARGIN
        centre = np.array([*start.container_xy, height / 2])
        self.arm.put_cylinder("container", radius, height, centre)

    def _put_object(self, spec: ObjectSpec, start: Start, present: bool) -> None:
        """Put a box around the object where it stands at the start, or remove it."""
        if not present:
            self.arm.remove("object")
            return
        sides = 2.0 * np.array(spec.half_size) + (2.0 * MARGIN, 2.0 * MARGIN, MARGIN)
        centre = np.array([*start.object_xy, sides[2] / 2])
        self.arm.put_box("object", sides, centre, start.object_yaw)

    def _points(self, place: np.ndarray, waypoint: Waypoint) -> list[Waypoint]:
        """Return the points between `place` (3,) and the waypoint; none on a straight line."""
        path = self._path(place, waypoint)
        if path is None:
            return []
        return [
            Waypoint(above_table(point), POINT_TOLERANCE, waypoint.gripper, patience=POINT_PATIENCE)
            for point in resample(path, POINT_SPACING)[1:-1]
        ]

    def _path(self, place: np.ndarray, waypoint: Waypoint) -> np.ndarray | None:
        """Return TCP positions (N, 3) from `place` (3,) to the waypoint; None for a straight line."""
        finger = GRIPPER_OPEN if waypoint.gripper == OPEN else 0.0
        line = resample(np.array([place, waypoint.position]), CHECK_SPACING)
        first, last = (self.arm.configuration_at(point, self.arm.rest, finger) for point in line[[0, -1]])
        path, outcome = None, "unreachable"
        if first is not None and last is not None:
            if not waypoint.clear and all(
                self.arm.configuration_at(point, first, finger) is not None for point in line
            ):
                outcome = "straight"
            else:
                path = self.arm.plan_path(first, last)
                outcome = "no path" if path is None else "planned"
        logging.debug("mplib: from %s to %s: %s", place, waypoint.position, outcome)
        return path
