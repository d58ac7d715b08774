"""The robot among obstacles, in MPLib's planning world: inverse kinematics, collisions, paths around
obstacles.

MPLib 0.1.1 is loaded with two repairs: a function of numpy's C interface that it misses under numpy 2, and a
seed for its search.
"""

import ctypes
import importlib.util
from pathlib import Path
from typing import Any, Final

import numpy as np
from transforms3d.euler import euler2quat

from lerobot_dataset_maniskill.planners.follower import resample
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.maniskill.robot import BASE_POSITION, POINTING_DOWN, BaseAxesPanda

SEED: Final = 1
MAX_JOINT_STEP: Final = 0.1
"""Largest step of the joints between two samples of a search (rad). Larger steps give paths that wave the arm
about."""

JOINT_SPACING: Final = 0.03
"""Distance between the configurations whose TCP positions make up a path (rad)."""

SEARCH_SECONDS: Final = 1.0
"""Time after which a search is given up. It takes 10 to 20 ms where there is a path."""

COPY_INTO: Final = 50
"""Slot of `PyArray_CopyInto` in the table of numpy 2's C interface."""

COPY_INTO_OF_NUMPY_1: Final = 82
"""Slot in which MPLib looks for it. numpy 2 leaves this slot empty."""

SET_SEED: Final = "_ZN4ompl3RNG7setSeedEm"
"""`ompl::RNG::setSeed(unsigned long)`, as compilers on Linux mangle it."""


class PlanningArm:
    """ManiSkill's Panda in MPLib's planning world.

    Positions are (3,), metres, in the frame of the tasks. Configurations are (9,) joint positions: seven of
    the arm (rad), two of the fingers (m)."""

    def __init__(self) -> None:
        self._mplib, self._fcl = load_mplib()
        urdf, tcp = str(BaseAxesPanda.urdf_path), BaseAxesPanda.ee_link_name
        self._planner: Any = self._mplib.Planner(urdf, move_group=tcp, srdf=urdf.replace(".urdf", ".srdf"))
        self._model, self._world = self._planner.pinocchio_model, self._planner.planning_world
        self._tcp = self._planner.move_group_link_id
        self._joints = len(self._planner.move_group_joint_indices)
        self._low, self._high = self._planner.joint_limits[: self._joints].T
        self.rest = np.array(BaseAxesPanda.keyframes["rest"].qpos, np.float64)

    def put_box(self, name: str, sides: np.ndarray, centre: np.ndarray, yaw: float = 0.0) -> None:
        """Put an obstacle of size `sides` (3,) at `centre` (3,), turned about z by `yaw` (rad)."""
        self._put(name, self._fcl.Box(*sides), centre, yaw)

    def put_cylinder(self, name: str, radius: float, height: float, centre: np.ndarray) -> None:
        """Put an upright cylinder at `centre` (3,)."""
        self._put(name, self._fcl.Cylinder(radius, height), centre, 0.0)

    def _put(self, name: str, shape: Any, centre: np.ndarray, yaw: float) -> None:
        place = np.asarray(centre) - BASE_POSITION
        self._planner.set_normal_object(name, self._fcl.CollisionObject(shape, place, euler2quat(0, 0, yaw)))

    def remove(self, name: str) -> None:
        """Remove the obstacle of that name, if there is one."""
        self._planner.remove_normal_object(name)

    def configuration_at(self, tcp: np.ndarray, near: np.ndarray, finger: float) -> np.ndarray | None:
        """Return the configuration that points down at `tcp` (3,), sought from the configuration `near`.

        Its fingers are at `finger` (m). None if it is out of the joints' limits or touches an obstacle.
        """
        pose = np.array([*(tcp - BASE_POSITION), *POINTING_DOWN])
        qpos, solved, _ = self._model.compute_IK_CLIK(self._tcp, pose, near)
        qpos[self._joints :] = finger
        joints = qpos[: self._joints]
        if not solved or (joints < self._low).any() or (joints > self._high).any():
            return None
        self._planner.robot.set_qpos(qpos, True)
        return None if self._world.collide() else qpos

    def plan_path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """Plan between two configurations by RRT-Connect (Kuffner and LaValle 2000), and shorten the path.

        MPLib's own `plan_qpos_to_qpos` would also smooth it by a spline, which leads back into the obstacles.

        Returns:
            TCP positions (N, 3), the same for the same arguments; None if no path is found.
        """
        self._planner.robot.set_qpos(start, True)
        seed_ompl(self._mplib, SEED)
        status, corners = self._planner.planner.plan(
            start[: self._joints], [goal[: self._joints]], time=SEARCH_SECONDS, range=MAX_JOINT_STEP
        )
        if status != "Exact solution":
            return None
        return np.array([self._tcp_position(joints) for joints in resample(corners, JOINT_SPACING)])

    def _tcp_position(self, joints: np.ndarray) -> np.ndarray:
        """Compute forward kinematics. (7,) → (3,)"""
        self._model.compute_forward_kinematics(np.array([*joints, 0.0, 0.0]))
        return self._model.get_link_pose(self._tcp)[:3] + BASE_POSITION


def load_mplib() -> tuple[Any, Any]:
    """Import MPLib, repaired for numpy 2.

    Returns:
        The package, and the module of its collision shapes (`fcl`).

    Raises:
        FieldError: if it is not installed.
    """
    if importlib.util.find_spec("mplib") is None:
        remedy = "install it with pip install '.[maniskill]' in the clone (Linux), or leave `planner` out"
        raise FieldError("planner", "mplib", "MPLib is not installed", remedy)
    restore_copy_into()
    import mplib
    from mplib.pymp.collision_detection import fcl

    return mplib, fcl


def restore_copy_into() -> None:
    """Let MPLib find `PyArray_CopyInto` under numpy 2, where its first planner would crash the process.

    MPLib 0.1.1 was built for numpy 1, and looks the function up when it is imported, so this comes before.
    It fills one empty slot; it does nothing under numpy 1, or if the slot is full.
    """
    if np.lib.NumpyVersion(np.__version__) < "2.0.0":
        return
    from numpy._core._multiarray_umath import _ARRAY_API  # type: ignore[import-not-found]

    prototype = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
    address_of = prototype(("PyCapsule_GetPointer", ctypes.pythonapi))
    table = ctypes.cast(address_of(_ARRAY_API, None), ctypes.POINTER(ctypes.c_void_p))
    if not table[COPY_INTO_OF_NUMPY_1]:
        table[COPY_INTO_OF_NUMPY_1] = table[COPY_INTO]


def seed_ompl(mplib: Any, seed: int) -> None:
    """Make the next plan a function of its problem and of `seed` (at least 1).

    MPLib offers no seed before 0.2, but the planning library that it brings along does.
    """
    (library,) = (Path(mplib.__file__).parents[1] / "mplib.libs").glob("libompl-*.so*")
    set_seed = ctypes.CDLL(str(library))[SET_SEED]
    set_seed.argtypes, set_seed.restype = (ctypes.c_ulong,), None
    set_seed(seed)
