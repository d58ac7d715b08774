"""The things of the scenes, as numbers: nothing is downloaded. Metres, z up, table top at z = 0."""

from dataclasses import dataclass
from typing import Final, Literal

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
    """Something to manipulate, standing on the table.

    Args:
        half_size: half extents in x, y, z. A cylinder stands upright.
        label: how an instruction calls it.
        profile: outline of a revolved shape.
        lies: whether it is revolved around x, not z.
        lobes: bulges around the axis, as a bell pepper has them.
        stalk: colour of a stalk at the upper (or far) end, which is only seen.
        mesh: of the shape "mesh", which has its own colours.
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
    """A plate (flat) or a bowl (with a rim): the target of pick_place, scenery in the other tasks."""

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

OBJECTS: Final[dict[str, ObjectSpec]] = {
    spec.name: spec
    for spec in (
        ObjectSpec("sponge", "box", (0.030, 0.034, 0.022), (0.95, 0.72, 0.08), "yellow sponge"),
        ObjectSpec("tomato_can", "cylinder", (0.031, 0.031, 0.030), (0.80, 0.07, 0.06), "tomato can"),
        ObjectSpec("blue_box", "box", (0.028, 0.028, 0.028), (0.06, 0.16, 0.62), "blue box"),
        ObjectSpec("lime", "ellipsoid", (0.030, 0.035, 0.028), (0.22, 0.62, 0.10), "lime"),
        ObjectSpec("lemon", "ellipsoid", (0.034, 0.026, 0.026), (0.98, 0.88, 0.20), "lemon"),
        ObjectSpec("peach", "ellipsoid", (0.032, 0.032, 0.030), (0.98, 0.58, 0.42), "peach"),
        ObjectSpec(
            "bell_pepper", "revolved", (0.031, 0.031, 0.034), (0.08, 0.42, 0.06), "green bell pepper",
            profile=PEPPER, lobes=4, stalk=(0.35, 0.30, 0.08),
        ),
        ObjectSpec("garlic", "revolved", (0.028, 0.028, 0.030), (0.95, 0.92, 0.86), "garlic", profile=GARLIC),
        ObjectSpec(
            "carrot", "revolved", (0.042, 0.019, 0.019), (0.95, 0.38, 0.03), "carrot",
            profile=CARROT, lies=True, stalk=GREEN,
        ),
        ObjectSpec("tomato", "ellipsoid", (0.033, 0.033, 0.028), (0.85, 0.05, 0.03), "tomato", stalk=GREEN),
        ObjectSpec(
            "pear", "revolved", (0.029, 0.029, 0.040), (0.72, 0.75, 0.18), "pear",
            profile=PEAR, stalk=(0.30, 0.18, 0.08),
        ),
        ObjectSpec(
            "aubergine", "revolved", (0.044, 0.025, 0.025), (0.22, 0.05, 0.28), "aubergine",
            profile=AUBERGINE, lies=True, stalk=GREEN,
        ),
        ObjectSpec("potato", "ellipsoid", (0.037, 0.028, 0.025), (0.58, 0.42, 0.22), "potato"),
        ObjectSpec(
            "apple", "revolved", (0.033, 0.033, 0.031), (0.62, 0.04, 0.10), "red apple",
            profile=APPLE, stalk=(0.25, 0.15, 0.06),
        ),
        ObjectSpec("orange", "ellipsoid", (0.033, 0.033, 0.033), (0.98, 0.48, 0.02), "orange"),
        ObjectSpec("soap", "box", (0.032, 0.024, 0.016), (0.95, 0.62, 0.72), "pink soap"),
        ObjectSpec("cup", "revolved", (0.032, 0.032, 0.032), (0.05, 0.52, 0.52), "teal cup", profile=CUP),
        ObjectSpec("tea_tin", "box", (0.023, 0.023, 0.036), (0.05, 0.22, 0.14), "dark green tea tin"),
        ObjectSpec("wooden_block", "box", (0.026, 0.020, 0.026), (0.76, 0.58, 0.36), "wooden block"),
        ObjectSpec("glue_stick", "cylinder", (0.018, 0.018, 0.036), (0.45, 0.12, 0.62), "purple glue stick"),
    )
}  # fmt: skip
"""Twenty things, told apart by shape, size and colour, each narrow enough for the gripper (8 cm).

`assets.use_assets` puts a user's own in their places."""

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
