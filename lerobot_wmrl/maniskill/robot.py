"""The robot: ManiSkill's Panda, commanded by pose deltas in metres and radians along the base's axes."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import sapien
from mani_skill.agents.controllers import PDEEPoseControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda import Panda
from sapien.wrapper.pinocchio_model import PinocchioModel

CONTROL_MODE = "base_delta_pose"
BASE_POSITION = (-0.615, 0.0, 0.0)
POINTING_DOWN = (0.0, 1.0, 0.0, 0.0)
"""Quaternion (wxyz) of a gripper that points down."""

GRIPPER_OPEN = 0.04
"""Finger joint position (m) of the open gripper."""

FINE_LINKS = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
"""Links that keep more triangles, because their outline shows whether there is contact."""

FEWEST_TRIANGLES = 120
"""Triangles that a part of a link keeps at least."""


@register_agent()
class BaseAxesPanda(Panda):
    """Panda whose rotation actions turn by the angles they state.

    ManiSkill's own `pd_ee_delta_pose` scales rotations by its (negative) lower bound. Without normalisation
    the action is in metres and radians, and nothing is clipped: the caller clips to the action box.
    """

    uid = "wmrl_panda"

    @property
    def _controller_configs(self) -> dict[str, Any]:
        arm = PDEEPoseControllerConfig(
            joint_names=self.arm_joint_names,
            pos_lower=-np.inf,
            pos_upper=np.inf,
            stiffness=self.arm_stiffness,
            damping=self.arm_damping,
            force_limit=self.arm_force_limit,
            ee_link=self.ee_link_name,
            urdf_path=self.urdf_path,
            frame="root_translation:root_aligned_body_rotation",
            normalize_action=False,
        )
        return {
            CONTROL_MODE: {"arm": arm, "gripper": super()._controller_configs["pd_ee_delta_pose"]["gripper"]}
        }


class InverseKinematics:
    """Inverse kinematics of a gripper that points down, on the CPU, starting from the rest position.

    It runs on the CPU whatever the simulation runs on, so that starts do not depend on the device.
    """

    def __init__(self, agent: Panda) -> None:
        joints = [joint.name for joint in agent.robot.active_joints]
        links = [link.name for link in agent.robot.links]
        self.model = PinocchioModel(Path(agent.urdf_path).read_text(), [0.0, 0.0, -9.81])
        self.model.set_joint_order(joints)
        self.model.set_link_order(links)
        self.end_link = links.index(agent.ee_link_name)
        self.movable = np.array([name in agent.arm_joint_names for name in joints])
        self.rest = np.array(agent.keyframes["rest"].qpos, np.float64)
        self.rest[-2:] = 0.0

    def solve(self, tcp: np.ndarray, finger: float) -> np.ndarray:
        """Return joint positions (9,) for the TCP at `tcp` (3,) and fingers at `finger` (m).

        Raises:
            RuntimeError: if there are none.
        """
        target = sapien.Pose(p=np.asarray(tcp) - np.array(BASE_POSITION), q=POINTING_DOWN)
        qpos, solved, _ = self.model.compute_inverse_kinematics(
            self.end_link, target, initial_qpos=self.rest, active_qmask=self.movable, max_iterations=200
        )
        if not solved:
            raise RuntimeError(f"inverse kinematics failed for the start position {np.round(tcp, 3)}")
        qpos[-2:] = finger
        return qpos


DECIMATED: dict[tuple[bytes, float], tuple[np.ndarray, ...]] = {}
"""Decimated meshes by a digest of the full one, and the share of its triangles: robots share them, also those
of the next simulator in this process."""


def lighten_meshes(robot: Any, detail: float) -> None:
    """Replace the robot's visual meshes by decimated ones with the share `detail` of their triangles.

    Software rendering is bound by vertices: 4 % of the triangles draw several times faster and look the same
    at 64 and 128 px.
    """
    for name, body in _render_bodies(robot):
        share = min(1.0, 3.0 * detail) if name in FINE_LINKS else detail
        light = sapien.render.RenderBodyComponent()
        for shape in body.render_shapes:
            for part in shape.parts:
                if len(part.triangles):
                    vertices, triangles = (np.asarray(each) for each in (part.vertices, part.triangles))
                    key = hashlib.sha256(b"".join((vertices.tobytes(), triangles.tobytes()))).digest(), share
                    if key not in DECIMATED:
                        DECIMATED[key] = _decimated(vertices, triangles, share)
                    mesh = sapien.render.RenderShapeTriangleMesh(*DECIMATED[key], part.material)
                    mesh.local_pose = shape.local_pose
                    light.attach(mesh)
        entity = body.entity
        entity.remove_component(body)  # a batched renderer draws the first component that it finds
        entity.add_component(light)


def _render_bodies(robot: Any) -> Iterator[tuple[str, Any]]:
    for link in robot.links:
        for body in link._objs:
            component = body.entity.find_component_by_type(sapien.render.RenderBodyComponent)
            if component is not None:
                yield link.name, component


def _decimated(vertices: np.ndarray, triangles: np.ndarray, share: float) -> tuple[np.ndarray, ...]:
    """Return a mesh with `share` of its triangles, at least `FEWEST_TRIANGLES`.

    Returns:
        Vertices (V, 3), triangles (F, 3), normals (V, 3), and an empty array for texture coordinates.
    """
    vertices, inverse = np.unique(vertices.astype(np.float32).round(5), axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[triangles].astype(np.int32)
    reduction = 1.0 - max(FEWEST_TRIANGLES, share * len(triangles)) / len(triangles)
    if reduction > 0:
        vertices, triangles = fast_simplification.simplify(vertices, triangles, reduction)
    normals = _vertex_normals(vertices, triangles)
    no_texture = np.zeros((0, 2), np.float32)
    return vertices.astype(np.float32), triangles.astype(np.uint32), normals, no_texture


def _vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the area-weighted mean of the adjoining faces' normals at each vertex (V, 3)."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices, dtype=np.float64)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)
