"""The things on the table, as numbers, and a user's own meshes in their place. Imports no simulator.

Nothing is downloaded. Units are metres, z points up, the table top is at z = 0.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import yaml

from lerobot_wmrl.common.errors import FieldError, suggestion
from lerobot_wmrl.maniskill.backend import require_simulator

Shape = Literal["box", "cylinder", "ellipsoid", "revolved", "mesh"]
Colour = tuple[float, float, float]
Profile = tuple[tuple[float, float], ...]
"""Radius (as a share of the largest) by height (from −1 at one end to 1 at the other)."""


@dataclass(frozen=True)
class MeshFile:
    """A mesh on disk: its path, the factor that makes its units metres, and its centre thereafter (m)."""

    path: str
    scale: float
    centre: tuple[float, float, float]


@dataclass(frozen=True)
class ObjectSpec:
    """An object to manipulate, standing on the table.

    Args:
        name: key in `OBJECTS`, part of a scene.
        shape: how its mesh is made. A cylinder stands upright.
        half_size: half extents in x, y, z (m).
        colour: RGB in [0, 1].
        label: how an instruction calls it.
        profile: outline of a revolved shape.
        lies: whether it is revolved around x, not z.
        lobes: bulges around the axis, as a bell pepper has them.
        stalk: colour of a stalk at the upper (or far) end, which has no collision shape.
        density: kg/m³.
        mesh: the file, for the shape "mesh". It has its own colours.
    """

    name: str
    shape: Shape
    half_size: tuple[float, float, float]
    colour: Colour
    label: str
    profile: Profile = ()
    lies: bool = False
    lobes: int = 0
    stalk: Colour | None = None
    density: float = 500.0
    mesh: MeshFile | None = None


@dataclass(frozen=True)
class ContainerSpec:
    """A plate or a bowl: the target of pick_place, scenery in the other tasks. Metres."""

    name: str
    radius: float
    height: float
    colour: Colour
    label: str


PEAR: Profile = ((0.35, -1.0), (0.8, -0.8), (1.0, -0.4), (0.92, 0.0), (0.6, 0.45), (0.42, 0.75), (0.2, 1.0))
PEPPER: Profile = ((0.5, -1.0), (0.8, -0.85), (0.95, -0.2), (1.0, 0.45), (0.85, 0.85), (0.45, 1.0))
GARLIC: Profile = ((0.4, -1.0), (0.9, -0.75), (1.0, -0.4), (0.8, 0.05), (0.35, 0.4), (0.2, 1.0))
CARROT: Profile = ((0.6, -1.0), (1.0, -0.8), (0.85, -0.2), (0.6, 0.5), (0.3, 1.0))
AUBERGINE: Profile = ((0.5, -1.0), (0.9, -0.8), (1.0, -0.35), (0.8, 0.3), (0.6, 0.75), (0.35, 1.0))
APPLE: Profile = (
    (0.4, -1.0),
    (0.75, -0.85),
    (0.95, -0.35),
    (1.0, 0.15),
    (0.85, 0.7),
    (0.5, 0.95),
    (0.2, 1.0),
)
CUP: Profile = ((0.75, -1.0), (1.0, 1.0))

GREEN: Final[Colour] = (0.10, 0.38, 0.08)

OBJECTS: Final[Mapping[str, ObjectSpec]] = {
    spec.name: spec
    for spec in (
        ObjectSpec("sponge", "box", (0.030, 0.034, 0.022), (0.95, 0.72, 0.08), "yellow sponge"),
        ObjectSpec("tomato_can", "cylinder", (0.031, 0.031, 0.030), (0.80, 0.07, 0.06), "tomato can"),
        ObjectSpec("blue_box", "box", (0.028, 0.028, 0.028), (0.06, 0.16, 0.62), "blue box"),
        ObjectSpec("lime", "ellipsoid", (0.030, 0.035, 0.028), (0.22, 0.62, 0.10), "lime"),
        ObjectSpec("lemon", "ellipsoid", (0.034, 0.026, 0.026), (0.98, 0.88, 0.20), "lemon"),
        ObjectSpec("peach", "ellipsoid", (0.032, 0.032, 0.030), (0.98, 0.58, 0.42), "peach"),
        ObjectSpec(
            "bell_pepper",
            "revolved",
            (0.031, 0.031, 0.034),
            (0.08, 0.42, 0.06),
            "green bell pepper",
            profile=PEPPER,
            lobes=4,
            stalk=(0.35, 0.30, 0.08),
        ),
        ObjectSpec("garlic", "revolved", (0.028, 0.028, 0.030), (0.95, 0.92, 0.86), "garlic", profile=GARLIC),
        ObjectSpec(
            "carrot",
            "revolved",
            (0.042, 0.019, 0.019),
            (0.95, 0.38, 0.03),
            "carrot",
            profile=CARROT,
            lies=True,
            stalk=GREEN,
        ),
        ObjectSpec("tomato", "ellipsoid", (0.033, 0.033, 0.028), (0.85, 0.05, 0.03), "tomato", stalk=GREEN),
        ObjectSpec(
            "pear",
            "revolved",
            (0.029, 0.029, 0.040),
            (0.72, 0.75, 0.18),
            "pear",
            profile=PEAR,
            stalk=(0.30, 0.18, 0.08),
        ),
        ObjectSpec(
            "aubergine",
            "revolved",
            (0.044, 0.025, 0.025),
            (0.22, 0.05, 0.28),
            "aubergine",
            profile=AUBERGINE,
            lies=True,
            stalk=GREEN,
        ),
        ObjectSpec("potato", "ellipsoid", (0.037, 0.028, 0.025), (0.58, 0.42, 0.22), "potato"),
        ObjectSpec(
            "apple",
            "revolved",
            (0.033, 0.033, 0.031),
            (0.62, 0.04, 0.10),
            "red apple",
            profile=APPLE,
            stalk=(0.25, 0.15, 0.06),
        ),
        ObjectSpec("orange", "ellipsoid", (0.033, 0.033, 0.033), (0.98, 0.48, 0.02), "orange"),
        ObjectSpec("soap", "box", (0.032, 0.024, 0.016), (0.95, 0.62, 0.72), "pink soap"),
        ObjectSpec("cup", "revolved", (0.032, 0.032, 0.032), (0.05, 0.52, 0.52), "teal cup", profile=CUP),
        ObjectSpec("tea_tin", "box", (0.023, 0.023, 0.036), (0.05, 0.22, 0.14), "dark green tea tin"),
        ObjectSpec("wooden_block", "box", (0.026, 0.020, 0.026), (0.76, 0.58, 0.36), "wooden block"),
        ObjectSpec("glue_stick", "cylinder", (0.018, 0.018, 0.036), (0.45, 0.12, 0.62), "purple glue stick"),
    )
}
"""Twenty objects that differ in shape, size and colour, each narrow enough for the gripper (8 cm)."""

CONTAINERS: Final = {
    spec.name: spec
    for spec in (
        ContainerSpec("plate", 0.060, 0.010, (0.92, 0.92, 0.90), "white plate"),
        ContainerSpec("bowl", 0.055, 0.045, (0.35, 0.20, 0.45), "purple bowl"),
    )
}

TABLES: Final[dict[str, Colour]] = {"wood": (0.50, 0.36, 0.22), "slate": (0.36, 0.40, 0.44)}

CARPET_RADIUS: Final = 0.05
CARPET_COLOUR: Final[Colour] = (0.10, 0.60, 0.85)
"""The target of move_to_aim: a flat round mat."""

ASSET_KEYS: Final = ("mesh", "label", "scale", "density")
MAX_ASSET_WIDTH: Final = 0.072
"""Largest width along y (m) that the fingers, which open 8 cm, can grasp."""

MIN_ASSET_HEIGHT: Final = 0.02
"""Least height (m) that a closed gripper can push."""


def read_assets(path: Path) -> dict[str, ObjectSpec]:
    """Read a user's own meshes (YCB or others), to use in place of the objects made by code.

    Args:
        path: a YAML file with one line an object, such as
            `lemon: {mesh: ycb/014_lemon/textured.obj, label: lemon, scale: 1.0, density: 500}`. A relative
            mesh is looked for beside the file; everything but `mesh` may be left out.

    Returns:
        Object name → its new specification.

    Raises:
        FieldError: names the entry that cannot be used, and the remedy.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise FieldError("assets", path, f"cannot be read ({error})") from error
    if not isinstance(content, dict) or not all(isinstance(entry, dict) for entry in content.values()):
        raise FieldError("assets", path, "must hold lines like lemon: {mesh: lemon.obj}")
    return {name: _specification(path, str(name), entry) for name, entry in content.items()}


def describe_assets(path: Path) -> dict[str, dict[str, Any]]:
    """Describe a user's meshes by their content, wherever the files lie: object name → JSON values."""
    described = {}
    for name, spec in read_assets(path).items():
        assert spec.mesh is not None
        described[name] = {
            "label": spec.label,
            "density": spec.density,
            "half_size": [round(x, 6) for x in spec.half_size],
            "scale": spec.mesh.scale,
            "sha256": hashlib.sha256(Path(spec.mesh.path).read_bytes()).hexdigest(),
        }
    return described


def _specification(path: Path, name: str, entry: dict[str, Any]) -> ObjectSpec:
    _check_name(path, "object", name, tuple(OBJECTS))
    for key in entry:
        _check_name(path, f"key of {name}", str(key), ASSET_KEYS)
    if "mesh" not in entry:
        raise FieldError("assets", path, f"{name} has no mesh", "add mesh: and its file")
    file = path.parent / str(entry["mesh"])
    scale, density = (_positive(path, name, entry, *pair) for pair in (("scale", 1.0), ("density", 500.0)))
    require_simulator()
    import trimesh

    try:
        low, high = scale * np.asarray(trimesh.load(file, force="mesh").bounds)
    except Exception as error:  # whatever a mesh format's reader raises
        raise FieldError("assets", path, f"{name}.mesh={file} cannot be loaded ({error})") from error
    half_size = (high - low) / 2
    _check_size(path, name, half_size, scale)
    centre = (low + high) / 2
    return replace(
        OBJECTS[name],
        shape="mesh",
        half_size=tuple(half_size.tolist()),
        mesh=MeshFile(str(file.resolve()), scale, tuple(centre.tolist())),
        label=str(entry.get("label", OBJECTS[name].label)),
        density=density,
    )


def _positive(path: Path, name: str, entry: dict[str, Any], key: str, default: float) -> float:
    value = entry.get(key, default)
    if not isinstance(value, int | float) or not 0 < value < np.inf:
        raise FieldError("assets", path, f"{name}.{key}={value!r} must be a number above 0")
    return float(value)


def _check_name(path: Path, what: str, name: str, known: tuple[str, ...]) -> None:
    if name in known:
        return
    raise FieldError("assets", path, f"the {what} {name!r} is unknown", suggestion(name, known))


def _check_size(path: Path, name: str, half_size: np.ndarray, scale: float) -> None:
    width, height = 2 * half_size[1], 2 * half_size[2]
    if width > MAX_ASSET_WIDTH:
        raise FieldError(
            "assets",
            path,
            f"{name} is {100 * width:.1f} cm wide along y, more than the gripper gets around "
            f"({100 * MAX_ASSET_WIDTH:.1f} cm)",
            f"turn the mesh, or set its scale to at most {scale * MAX_ASSET_WIDTH / width:.3g}",
        )
    if height < MIN_ASSET_HEIGHT:
        raise FieldError(
            "assets",
            path,
            f"{name} is {100 * height:.2g} cm high, too low to be pushed (at least "
            f"{100 * MIN_ASSET_HEIGHT:.0f} cm)",
            "if its units are not metres, set its scale",
        )
