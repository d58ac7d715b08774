"""The robot among obstacles: which places it reaches without touching any, and its ways around them."""

from typing import Any, Final

import mplib
import numpy as np
from mplib.pymp.collision_detection import fcl
from transforms3d.euler import euler2quat

from lerobot_dataset_maniskill.planners.joint_space.polyline import resampled
from lerobot_dataset_maniskill.planners.joint_space.seed import seed_ompl
from lerobot_wmrl.maniskill.robot import BASE_POSITION, POINTING_DOWN, BaseAxesPanda

SEED: Final = 1
LONGEST_MOTION: Final = 0.1
"""Of the joints, between two samples of a search (rad). Longer ones make ways that wave the arm about."""

JOINT_SPACING: Final = 0.03
"""Of the configurations whose TCP positions make up a way (rad)."""

SEARCH_S: Final = 1.0
"""When a search is given up (s). It takes 10 to 20 ms where there is a way."""


class PlanningArm:
    """ManiSkill's Panda in mplib's planning world.

    Positions are (3,) metres in the frame of the tasks. Configurations are (9,) joint positions: seven of the
    arm (rad), two of the fingers (m).
    """

    def __init__(self) -> None:
        urdf, tcp = str(BaseAxesPanda.urdf_path), BaseAxesPanda.ee_link_name
        self._planner: Any = mplib.Planner(urdf, move_group=tcp, srdf=urdf.replace(".urdf", ".srdf"))
        self._model, self._world = self._planner.pinocchio_model, self._planner.planning_world
        self._tcp = self._planner.move_group_link_id
        self._joints = len(self._planner.move_group_joint_indices)
        self._low, self._high = self._planner.joint_limits[: self._joints].T
        self.rest = np.array(BaseAxesPanda.keyframes["rest"].qpos, np.float64)

    def put(self, name: str, shape: Any, centre: np.ndarray, yaw: float = 0.0) -> None:
        """Let an obstacle, a geometry of fcl, stand at `centre` (3,), turned about z by `yaw` (rad)."""
        place = np.asarray(centre) - BASE_POSITION
        self._planner.set_normal_object(name, fcl.CollisionObject(shape, place, euler2quat(0, 0, yaw)))

    def take_away(self, name: str) -> None:
        """Let there be no obstacle of that name."""
        self._planner.remove_normal_object(name)

    def reach(self, tcp: np.ndarray, near: np.ndarray, finger: float) -> np.ndarray | None:
        """The configuration with the gripper pointing down at `tcp` that is next to `near`.

        Its fingers are at `finger` (m). None if it is out of the joints' limits or touches an obstacle.
        """
        pose = np.array([*(tcp - BASE_POSITION), *POINTING_DOWN])
        found, solved, _ = self._model.compute_IK_CLIK(self._tcp, pose, near)
        found[self._joints :] = finger
        joints = found[: self._joints]
        if not solved or (joints < self._low).any() or (joints > self._high).any():
            return None
        self._planner.robot.set_qpos(found, True)
        return None if self._world.collide() else found

    def way(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """TCP positions (N, 3) on a way between two configurations, if one is found; the same every time.

        RRT-Connect (Kuffner and LaValle 2000), then shortened. The planner's own `plan_qpos_to_qpos` would
        also smooth it by a spline, which leads back into the obstacles.
        """
        self._planner.robot.set_qpos(start, True)
        seed_ompl(SEED)
        status, corners = self._planner.planner.plan(
            start[: self._joints], [goal[: self._joints]], time=SEARCH_S, range=LONGEST_MOTION
        )
        if status != "Exact solution":
            return None
        return np.array([self._tcp_position(joints) for joints in resampled(corners, JOINT_SPACING)])

    def _tcp_position(self, joints: np.ndarray) -> np.ndarray:
        """Forward kinematics. (7,) → (3,)"""
        self._model.compute_forward_kinematics(np.array([*joints, 0.0, 0.0]))
        return self._model.get_link_pose(self._tcp)[:3] + BASE_POSITION
