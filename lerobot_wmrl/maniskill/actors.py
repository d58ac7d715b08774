"""Builds the things of `objects.py` in the simulator: their meshes by formula, and their physics."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import sapien
import trimesh

from lerobot_wmrl.maniskill.objects import (
    CARPET_COLOUR,
    CARPET_RADIUS,
    TABLES,
    Colour,
    ContainerSpec,
    ObjectSpec,
)

OBJECT_FRICTION: Final = 0.6
WALL_BOXES: Final = 16
"""Number of boxes in the wall around a container, which keeps its content from rolling out."""

CARPET_THICKNESS: Final = 0.001
UPRIGHT: Final = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
"""Rotation (wxyz) that stands a cylinder upright; SAPIEN's lie along x."""

MESH_SECTIONS: Final = 24
LOBE_DEPTH: Final = 0.10
"""Depth of the grooves between lobes, as a share of the radius."""

BOWL_WALL: Final = 0.006
"""Thickness of a container's wall and floor (m)."""

FLOOR_SHARE: Final = 0.6
"""Radius of a container's flat floor, as a share of its rim's."""


def render_material(colour: Colour) -> Any:
    """Return a matt material: highlights would only cost the frame tokenizer."""
    return sapien.render.RenderMaterial(base_color=[*colour, 1.0], roughness=0.9, specular=0.1, metallic=0.0)


def build_object(scene: Any, spec: ObjectSpec, place: sapien.Pose) -> Any:
    """Build a dynamic actor in a ManiSkill scene. Meshes collide as their convex hulls.

    Args:
        scene: ManiSkill's scene.
        spec: the object.
        place: its pose, different for every actor: physics on CUDA starts by looking for contacts.

    Returns:
        ManiSkill's actor.
    """
    builder = scene.create_actor_builder()
    surface = sapien.physx.PhysxMaterial(OBJECT_FRICTION, OBJECT_FRICTION, 0.0)
    material = render_material(spec.colour)
    radius, _, half_z = spec.half_size
    builder.initial_pose = place
    if spec.shape == "box":
        builder.add_box_collision(half_size=spec.half_size, material=surface, density=spec.density)
        builder.add_box_visual(half_size=spec.half_size, material=material)
        return builder.build(name=spec.name)
    if spec.shape == "cylinder":
        upright = sapien.Pose(q=UPRIGHT)
        builder.add_cylinder_collision(upright, radius, half_z, material=surface, density=spec.density)
        builder.add_cylinder_visual(upright, radius, half_z, material=material)
        return builder.build(name=spec.name)
    if spec.mesh is not None:
        scale, pose = [spec.mesh.scale] * 3, sapien.Pose(p=-np.array(spec.mesh.centre))
        builder.add_convex_collision_from_file(
            spec.mesh.path, scale=scale, pose=pose, material=surface, density=spec.density
        )
        builder.add_visual_from_file(spec.mesh.path, scale=scale, pose=pose)
        return builder.build(name=spec.name)
    meshes = [(object_mesh(spec), material)]
    if spec.stalk is not None:
        meshes.append((stalk_mesh(spec), render_material(spec.stalk)))
    with _mesh_files([mesh for mesh, _ in meshes]) as files:
        builder.add_convex_collision_from_file(files[0], material=surface, density=spec.density)
        for file, (_, colour) in zip(files, meshes, strict=True):
            builder.add_visual_from_file(file, material=colour)
        return builder.build(name=spec.name)


def build_container(scene: Any, spec: ContainerSpec, place: sapien.Pose) -> Any:
    """Build a kinematic actor: a floor to lie on and a ring of tilted boxes as its wall."""
    builder = scene.create_actor_builder()
    floor = sapien.Pose(p=[0, 0, BOWL_WALL / 2], q=UPRIGHT)
    builder.add_cylinder_collision(floor, FLOOR_SHARE * spec.radius, BOWL_WALL / 2)
    for pose, half_size in wall_boxes(spec):
        builder.add_box_collision(pose, half_size=half_size)
    builder.initial_pose = place
    with _mesh_files([container_mesh(spec)]) as files:
        builder.add_visual_from_file(files[0], material=render_material(spec.colour))
        return builder.build_kinematic(name=spec.name)


def wall_boxes(spec: ContainerSpec) -> Iterator[tuple[Any, list[float]]]:
    """Yield poses and half sizes of the boxes between the floor's edge and the rim."""
    inner, outer = FLOOR_SHARE * spec.radius, spec.radius
    slope = np.hypot(outer - inner, spec.height)
    tilt = np.arctan2(outer - inner, spec.height)
    half_size = [BOWL_WALL / 2, outer * np.tan(np.pi / WALL_BOXES), slope / 2]
    middle = (inner + outer) / 2
    for angle in np.arange(WALL_BOXES) * 2 * np.pi / WALL_BOXES:
        place = [middle * np.cos(angle), middle * np.sin(angle), spec.height / 2]
        turn = trimesh.transformations.quaternion_multiply(
            trimesh.transformations.quaternion_about_axis(angle, (0, 0, 1)),
            trimesh.transformations.quaternion_about_axis(tilt, (0, 1, 0)),
        )
        yield sapien.Pose(p=place, q=turn), half_size


def build_carpet(scene: Any, place: sapien.Pose) -> Any:
    """Build the mat of move_to_aim. It has no collision shape, so nothing catches on its edge."""
    builder = scene.create_actor_builder()
    pose = sapien.Pose(p=[0, 0, CARPET_THICKNESS / 2], q=UPRIGHT)
    builder.add_cylinder_visual(pose, CARPET_RADIUS, CARPET_THICKNESS / 2, render_material(CARPET_COLOUR))
    builder.initial_pose = place
    return builder.build_kinematic(name="carpet")


def build_table(scene: Any, name: str, place: sapien.Pose) -> Any:
    """Build the table: one box, in one plain colour. Its top is 5 cm above `place`."""
    half_size = (0.9, 1.2, 0.05)
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=half_size)
    builder.add_box_visual(half_size=half_size, material=render_material(TABLES[name]))
    builder.initial_pose = place
    return builder.build_kinematic(name=f"table_{name}")


@contextmanager
def _mesh_files(meshes: list[trimesh.Trimesh]) -> Iterator[list[str]]:
    """Write meshes to temporary files: SAPIEN loads meshes from files only, while it builds."""
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / f"{index}.obj") for index in range(len(meshes))]
        for mesh, file in zip(meshes, files, strict=True):
            mesh.export(file)
        yield files


def object_mesh(spec: ObjectSpec) -> trimesh.Trimesh:
    """Return an ellipsoid or a revolved shape that fills `half_size`, centred at the origin, z up."""
    round_one = spec.shape == "ellipsoid"
    mesh = trimesh.creation.icosphere(subdivisions=2) if round_one else _revolved(spec)
    mesh.apply_scale(spec.half_size / np.abs(mesh.bounds).max(0))
    return mesh


def stalk_mesh(spec: ObjectSpec) -> trimesh.Trimesh:
    """Return a short thin cylinder at the object's upper end, or at the far end if it lies."""
    axis = 0 if spec.lies else 2
    mesh = trimesh.creation.cylinder(radius=0.15 * spec.half_size[1], height=0.012, sections=8)
    if spec.lies:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    shift = np.zeros(3)
    shift[axis] = spec.half_size[axis] + 0.003
    mesh.apply_translation(shift)
    return mesh


def container_mesh(spec: ContainerSpec) -> trimesh.Trimesh:
    """Return a bowl or plate with its rim. Its underside is at z = 0."""
    radius, height = spec.radius, spec.height
    outline = np.array(
        [
            (0.0, 0.0),
            (FLOOR_SHARE * radius, 0.0),
            (radius, height),
            (radius - BOWL_WALL, height),
            (FLOOR_SHARE * radius - 0.5 * BOWL_WALL, BOWL_WALL),
            (0.0, BOWL_WALL),
        ]
    )
    return trimesh.creation.revolve(outline, sections=MESH_SECTIONS)


def _revolved(spec: ObjectSpec) -> trimesh.Trimesh:
    ends = ((0.0, spec.profile[0][1]), *spec.profile, (0.0, spec.profile[-1][1]))
    mesh = trimesh.creation.revolve(np.array(ends), sections=MESH_SECTIONS)
    if spec.lobes:
        x, y, _ = mesh.vertices.T
        bulge = 1 - LOBE_DEPTH * (1 + np.cos(spec.lobes * np.arctan2(y, x))) / 2
        mesh.vertices[:, :2] *= bulge[:, None]
    if spec.lies:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    return mesh
