"""Objects, containers and tables made by code: nothing is downloaded. Metres, z up, table top at z = 0."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import sapien
import trimesh

Shape = Literal["box", "cylinder", "ellipsoid"]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class ObjectSpec:
    """Something to manipulate, standing on the table.

    Args:
        half_size: half extents in x, y, z (a cylinder stands upright; its radius is x).
        label: how an instruction calls it.
    """

    name: str
    shape: Shape
    half_size: tuple[float, float, float]
    colour: Colour
    label: str
    density: float = 500.0


@dataclass(frozen=True)
class ContainerSpec:
    """A plate (flat) or a bowl (with a rim): scenery in push, a target in other tasks."""

    name: str
    radius: float
    height: float
    colour: Colour


OBJECTS: Final = {
    spec.name: spec
    for spec in (
        ObjectSpec("sponge", "box", (0.030, 0.034, 0.022), (0.95, 0.72, 0.08), "yellow sponge"),
        ObjectSpec("tomato_can", "cylinder", (0.031, 0.031, 0.030), (0.80, 0.07, 0.06), "tomato can"),
        ObjectSpec("blue_box", "box", (0.028, 0.028, 0.028), (0.06, 0.16, 0.62), "blue box"),
        ObjectSpec("lime", "ellipsoid", (0.030, 0.035, 0.028), (0.22, 0.62, 0.10), "lime"),
    )
}

CONTAINERS: Final = {
    spec.name: spec
    for spec in (
        ContainerSpec("plate", 0.060, 0.010, (0.92, 0.92, 0.90)),
        ContainerSpec("bowl", 0.055, 0.045, (0.35, 0.20, 0.45)),
    )
}

TABLES: Final[dict[str, Colour]] = {"wood": (0.50, 0.36, 0.22), "slate": (0.36, 0.40, 0.44)}

OBJECT_FRICTION: Final = 0.6


def render_material(colour: Colour) -> Any:
    """A matt surface: highlights would only cost the frame tokenizer."""
    return sapien.render.RenderMaterial(base_color=[*colour, 1.0], roughness=0.9, specular=0.1, metallic=0.0)


def build_object(scene: Any, spec: ObjectSpec) -> Any:
    """A dynamic actor of `spec` in a ManiSkill scene."""
    builder = scene.create_actor_builder()
    surface = sapien.physx.PhysxMaterial(OBJECT_FRICTION, OBJECT_FRICTION, 0.0)
    material = render_material(spec.colour)
    half_x, _, half_z = spec.half_size
    if spec.shape == "box":
        builder.add_box_collision(half_size=spec.half_size, material=surface, density=spec.density)
        builder.add_box_visual(half_size=spec.half_size, material=material)
    elif spec.shape == "cylinder":
        upright = sapien.Pose(q=[np.sqrt(0.5), 0, np.sqrt(0.5), 0])
        builder.add_cylinder_collision(upright, half_x, half_z, material=surface, density=spec.density)
        builder.add_cylinder_visual(upright, half_x, half_z, material=material)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=2)
        mesh.apply_scale(spec.half_size)
        return _build_mesh(builder, spec, mesh, material, surface)
    builder.initial_pose = sapien.Pose(p=[0, 0, half_z])
    return builder.build(name=spec.name)


def build_container(scene: Any, spec: ContainerSpec) -> Any:
    """A kinematic actor of `spec`; it collides as a solid disc of its height."""
    builder = scene.create_actor_builder()
    upright = sapien.Pose(p=[0, 0, spec.height / 2], q=[np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    builder.add_cylinder_collision(upright, spec.radius, spec.height / 2)
    builder.initial_pose = sapien.Pose()
    profile = _container_profile(spec)
    mesh = trimesh.creation.revolve(profile, sections=24)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{spec.name}.obj"
        mesh.export(file)
        builder.add_visual_from_file(str(file), material=render_material(spec.colour))
        return builder.build_kinematic(name=spec.name)


def build_table(scene: Any, name: str) -> Any:
    """The table: one box whose top is z = 0, in one plain colour."""
    half_size = (0.9, 1.2, 0.05)
    pose = sapien.Pose(p=[-0.1, 0, -half_size[2]])
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=half_size)
    builder.add_box_visual(half_size=half_size, material=render_material(TABLES[name]))
    builder.initial_pose = pose
    return builder.build_kinematic(name=f"table_{name}")


def _build_mesh(builder: Any, spec: ObjectSpec, mesh: Any, material: Any, surface: Any) -> Any:
    """SAPIEN loads meshes from files only, and reads them while it builds."""
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / f"{spec.name}.obj")
        mesh.export(file)
        builder.add_convex_collision_from_file(file, material=surface, density=spec.density)
        builder.add_visual_from_file(file, material=material)
        builder.initial_pose = sapien.Pose(p=[0, 0, spec.half_size[2]])
        return builder.build(name=spec.name)


def _container_profile(spec: ContainerSpec) -> np.ndarray:
    """(N, 2) radius and height of the outline that is revolved around z."""
    radius, height = spec.radius, spec.height
    wall = 0.006
    return np.array(
        [
            (0.0, 0.0),
            (0.6 * radius, 0.0),
            (radius, height),
            (radius - wall, height),
            (0.55 * radius, wall),
            (0.0, wall),
        ]
    )
