"""Ways between waypoints that lead around what stands on the table."""

import logging
from dataclasses import replace
from typing import Final

import numpy as np
from mplib.pymp.collision_detection import fcl

from lerobot_dataset_maniskill.planners.follower import OPEN, Plan, Waypoint, above_table
from lerobot_dataset_maniskill.planners.joint_space.arm import PlanningArm
from lerobot_dataset_maniskill.planners.joint_space.polyline import resampled
from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec
from lerobot_wmrl.maniskill.robot import GRIPPER_OPEN
from lerobot_wmrl.maniskill.tasks import Start

TABLE_SIZE: Final = (3.0, 3.0, 0.1)
TABLE_TOP: Final = -0.001
"""The robot's base stands on the table, and would collide with it at 0 (m)."""

MARGIN: Final = 0.01
"""Kept from the container and the object (m), for the follower cuts the corners of a way."""

SPACING: Final = 0.03
"""Between two points of a way (m)."""

VIA_TOLERANCE: Final = 0.018
VIA_PATIENCE: Final = 8
"""Steps after which a point of a way is given up: it takes 2 or 3, and nothing depends on it."""

STRIDE: Final = 0.01
"""Between the points of a straight line at which collisions are looked for (m)."""


class JointSpaceMotion:
    """A `motion.Motion` that keeps off the table, the container and, until it is to be touched, the object.

    A leg that is to keep clear of the object (`Waypoint.clear`) is planned in joint space. The others push,
    grasp or carry it: they stay straight lines where table and container permit, and are planned where not.
    A leg stays a straight line, too, if there is no way, as to a place inside the container, or if an end of
    it depends on where the object will be.
    """

    def __init__(self) -> None:
        self.arm = PlanningArm()
        self.arm.put("table", fcl.Box(*TABLE_SIZE), np.array([0.0, 0.0, TABLE_TOP - TABLE_SIZE[2] / 2]))

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
        """As a solid cylinder."""
        radius, height = container.radius + MARGIN, container.height + MARGIN
        self.arm.put("container", fcl.Cylinder(radius, height), np.array([*start.container_xy, height / 2]))

    def _put_object(self, spec: ObjectSpec, start: Start, there: bool) -> None:
        """As a box around it where it stands at the start, or not at all."""
        if not there:
            self.arm.take_away("object")
            return
        sides = 2.0 * np.array(spec.half_size) + (2.0 * MARGIN, 2.0 * MARGIN, MARGIN)
        self.arm.put("object", fcl.Box(*sides), np.array([*start.object_xy, sides[2] / 2]), start.object_yaw)

    def _points(self, place: np.ndarray, waypoint: Waypoint) -> list[Waypoint]:
        """What to pass between `place` (3,) and the waypoint: nothing on a straight line."""
        way = self._way(place, waypoint)
        if way is None:
            return []
        return [
            Waypoint(above_table(point), VIA_TOLERANCE, waypoint.gripper, patience=VIA_PATIENCE)
            for point in resampled(way, SPACING)[1:-1]
        ]

    def _way(self, place: np.ndarray, waypoint: Waypoint) -> np.ndarray | None:
        """TCP positions (N, 3) from `place` (3,) to the waypoint; None for a straight line."""
        finger = GRIPPER_OPEN if waypoint.gripper == OPEN else 0.0
        line = resampled(np.array([place, waypoint.position]), STRIDE)
        first, last = (self.arm.reach(point, self.arm.rest, finger) for point in line[[0, -1]])
        way, what = None, "unreachable"
        if first is not None and last is not None:
            if not waypoint.clear and all(self.arm.reach(point, first, finger) is not None for point in line):
                what = "straight"
            else:
                way = self.arm.way(first, last)
                what = "no way" if way is None else "planned"
        logging.debug("mplib: from %s to %s: %s", place, waypoint.position, what)
        return way
