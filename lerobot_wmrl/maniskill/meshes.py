"""Triangle meshes of the things, by formula. Metres, centred at the origin, z up."""

import numpy as np
import trimesh

from lerobot_wmrl.maniskill.objects import ContainerSpec, ObjectSpec

SECTIONS = 24
LOBE_DEPTH = 0.10
"""How much of the radius a lobe comes and goes by."""

BOWL_WALL = 0.006
FLOOR_SHARE = 0.6
"""Radius of a container's flat floor, as a share of its rim's."""


def object_mesh(spec: ObjectSpec) -> trimesh.Trimesh:
    """An ellipsoid or a revolved shape that fills `half_size`."""
    round_one = spec.shape == "ellipsoid"
    mesh = trimesh.creation.icosphere(subdivisions=2) if round_one else _revolved(spec)
    mesh.apply_scale(spec.half_size / np.abs(mesh.bounds).max(0))
    return mesh


def stalk_mesh(spec: ObjectSpec) -> trimesh.Trimesh:
    """A short thin cylinder out of the upper end, or the far end of what lies."""
    axis = 0 if spec.lies else 2
    mesh = trimesh.creation.cylinder(radius=0.15 * spec.half_size[1], height=0.012, sections=8)
    if spec.lies:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    shift = np.zeros(3)
    shift[axis] = spec.half_size[axis] + 0.003
    mesh.apply_translation(shift)
    return mesh


def container_mesh(spec: ContainerSpec) -> trimesh.Trimesh:
    """A bowl or plate with its rim; its underside is at z = 0."""
    radius, height = spec.radius, spec.height
    outline = np.array([
        (0.0, 0.0), (FLOOR_SHARE * radius, 0.0), (radius, height), (radius - BOWL_WALL, height),
        (FLOOR_SHARE * radius - 0.5 * BOWL_WALL, BOWL_WALL), (0.0, BOWL_WALL),
    ])  # fmt: skip
    return trimesh.creation.revolve(outline, sections=SECTIONS)


def _revolved(spec: ObjectSpec) -> trimesh.Trimesh:
    ends = ((0.0, spec.profile[0][1]), *spec.profile, (0.0, spec.profile[-1][1]))
    mesh = trimesh.creation.revolve(np.array(ends), sections=SECTIONS)
    if spec.lobes:
        x, y, _ = mesh.vertices.T
        bulge = 1 - LOBE_DEPTH * (1 + np.cos(spec.lobes * np.arctan2(y, x))) / 2
        mesh.vertices[:, :2] *= bulge[:, None]
    if spec.lies:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    return mesh
