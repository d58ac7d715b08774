"""A user's own meshes (YCB or others) in place of the objects made by code."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh
import yaml

from lerobot_wmrl.common.suggestion import suggestion
from lerobot_wmrl.maniskill.objects import OBJECTS, MeshFile, ObjectSpec

KEYS: Final = ("mesh", "label", "scale", "density")
WIDEST: Final = 0.072
"""What the fingers, which open 8 cm, can get around (m)."""

LOWEST: Final = 0.02
"""An object must be so high (m) for a closed gripper to push it."""


def use_assets(path: Path) -> None:
    """Let the meshes that the file names stand for the objects of those names, in this process."""
    OBJECTS.update(read_assets(path))


def read_assets(path: Path) -> dict[str, ObjectSpec]:
    """Object name → its new specification. ValueError that names the entry and the remedy.

    The file: `lemon: {mesh: ycb/014_lemon/textured.obj, label: lemon, scale: 1.0, density: 500}`, one line an
    object; a relative mesh is looked for beside the file, all but `mesh` may be left out.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"--env.assets={path}: cannot be read ({error})") from error
    if not isinstance(content, dict) or not all(isinstance(entry, dict) for entry in content.values()):
        raise ValueError(f"--env.assets={path}: must hold lines like `lemon: {{mesh: lemon.obj}}`")
    return {name: _specification(path, str(name), entry) for name, entry in content.items()}


def describe_assets(path: Path) -> dict[str, dict[str, Any]]:
    """What decides what the episodes look like, wherever the files lie: JSON values, by object name."""
    described = {}
    for name, spec in read_assets(path).items():
        assert spec.mesh is not None
        described[name] = {
            "label": spec.label, "density": spec.density, "half_size": [round(x, 6) for x in spec.half_size],
            "scale": spec.mesh.scale, "sha256": hashlib.sha256(Path(spec.mesh.path).read_bytes()).hexdigest(),
        }  # fmt: skip
    return described


def _specification(path: Path, name: str, entry: dict[str, Any]) -> ObjectSpec:
    _check_name(path, "object", name, tuple(OBJECTS))
    for key in entry:
        _check_name(path, f"key of {name}", str(key), KEYS)
    if "mesh" not in entry:
        raise ValueError(f"--env.assets={path}: {name} has no mesh; add `mesh: its file`")
    file = path.parent / str(entry["mesh"])
    scale, density = (_positive(path, name, entry, *pair) for pair in (("scale", 1.0), ("density", 500.0)))
    try:
        low, high = scale * np.asarray(trimesh.load(file, force="mesh").bounds)
    except Exception as error:  # whatever a mesh format's reader raises
        raise ValueError(f"--env.assets={path}: {name}.mesh={file} cannot be loaded ({error})") from error
    half_size = (high - low) / 2
    _check_size(path, name, half_size, scale)
    centre = (low + high) / 2
    return replace(
        OBJECTS[name], shape="mesh", half_size=tuple(half_size.tolist()),
        mesh=MeshFile(str(file.resolve()), scale, tuple(centre.tolist())),
        label=str(entry.get("label", OBJECTS[name].label)), density=density,
    )  # fmt: skip


def _positive(path: Path, name: str, entry: dict[str, Any], key: str, default: float) -> float:
    value = entry.get(key, default)
    if not isinstance(value, int | float) or not 0 < value < np.inf:
        raise ValueError(f"--env.assets={path}: {name}.{key}={value!r} must be a number above 0")
    return float(value)


def _check_name(path: Path, what: str, name: str, known: tuple[str, ...]) -> None:
    if name in known:
        return
    raise ValueError(f"--env.assets={path}: the {what} {name!r} is unknown; {suggestion(name, known)}")


def _check_size(path: Path, name: str, half_size: np.ndarray, scale: float) -> None:
    width, height = 2 * half_size[1], 2 * half_size[2]
    if width > WIDEST:
        raise ValueError(
            f"--env.assets={path}: {name} is {100 * width:.1f} cm wide along y, more than the gripper gets "
            f"around ({100 * WIDEST:.1f} cm); turn the mesh, or set its scale to at most "
            f"{scale * WIDEST / width:.3g}"
        )
    if height < LOWEST:
        raise ValueError(
            f"--env.assets={path}: {name} is {100 * height:.2g} cm high, too low to be pushed "
            f"(at least {100 * LOWEST:.0f} cm); are its units metres? Else set its scale"
        )
