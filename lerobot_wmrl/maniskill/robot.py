"""The robot: ManiSkill's Panda, commanded by delta poses in metres and radians along the base's axes."""

from collections.abc import Iterator
from typing import Any

import fast_simplification
import numpy as np
import sapien
from mani_skill.agents.controllers import PDEEPoseControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda import Panda

CONTROL_MODE = "base_delta_pose"
BASE_POSITION = (-0.615, 0.0, 0.0)
GRIPPER_OPEN = 0.04
"""Finger joint position (m) of the open gripper."""

FINE_LINKS = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
"""Links whose outline decides whether there is contact keep more triangles."""


@register_agent()
class BaseAxesPanda(Panda):
    """Panda whose rotation actions turn the way they say.

    ManiSkill's own `pd_ee_delta_pose` scales rotations by its (negative) lower bound. Without normalisation
    the action is metres and radians, and nothing is clipped: the caller clips to the action box.
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


def lighten_meshes(robot: Any, detail: float) -> None:
    """Replace the robot's visual meshes by decimated ones, `detail` of their triangles.

    Software rendering is bound by vertices: 4 % of the triangles draw several times faster and look the same
    at 64 px.
    """
    for name, body in _render_bodies(robot):
        share = min(1.0, 3.0 * detail) if name in FINE_LINKS else detail
        light = sapien.render.RenderBodyComponent()
        for shape in body.render_shapes:
            for part in shape.parts:
                if len(part.triangles):
                    mesh = _decimated(part, share)
                    mesh.local_pose = shape.local_pose
                    light.attach(mesh)
        body.disable()
        body.entity.add_component(light)


def _render_bodies(robot: Any) -> Iterator[tuple[str, Any]]:
    for link in robot.links:
        for body in link._objs:
            component = body.entity.find_component_by_type(sapien.render.RenderBodyComponent)
            if component is not None:
                yield link.name, component


def _decimated(part: Any, share: float, smallest: int = 120) -> Any:
    """One mesh part with `share` of its triangles (at least `smallest`) and smooth normals."""
    vertices, inverse = np.unique(np.asarray(part.vertices, np.float32).round(5), axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[np.asarray(part.triangles)].astype(np.int32)
    reduction = 1.0 - max(smallest, share * len(triangles)) / len(triangles)
    if reduction > 0:
        vertices, triangles = fast_simplification.simplify(vertices, triangles, reduction)
    return sapien.render.RenderShapeTriangleMesh(
        vertices.astype(np.float32),
        triangles.astype(np.uint32),
        _vertex_normals(vertices, triangles),
        np.zeros((0, 2), np.float32),
        part.material,
    )


def _vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(V, 3) area-weighted mean of the adjoining faces' normals."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices, dtype=np.float64)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)
