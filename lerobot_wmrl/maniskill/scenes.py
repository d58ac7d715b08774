"""The scenes: every object with every container on every table, and which of them training may see.

Imports no simulator.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final, Literal, get_args

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS, TABLES, ContainerSpec, ObjectSpec

Split = Literal["ind", "ood"]
SPLITS: Final[tuple[str, ...]] = get_args(Split)


@dataclass(frozen=True)
class Scene:
    """What is on the table, and whether training may see it.

    Args:
        index: stored in datasets, so it never changes.
        object: key of `objects.OBJECTS`.
        container: key of `objects.CONTAINERS`.
        table: key of `objects.TABLES`.
        split: "ind" (in domain: recorded and trained on) or "ood" (held out). An "ood" scene has either an
            object that no "ind" scene has, or a new combination of known things.
        mesh: a user's own mesh in the object's place.
    """

    index: int
    object: str
    container: str
    table: str
    split: Split
    mesh: ObjectSpec | None = None

    @property
    def object_spec(self) -> ObjectSpec:
        """What the object is: the user's mesh, else what `objects.OBJECTS` says."""
        return self.mesh or OBJECTS[self.object]

    @property
    def container_spec(self) -> ContainerSpec:
        """What `objects.CONTAINERS` says of the container."""
        return CONTAINERS[self.container]

    def as_json(self) -> dict[str, Any]:
        """Return what datasets store of a scene."""
        return {field: getattr(self, field) for field in ("index", "object", "container", "table", "split")}


UNSEEN_OBJECTS: Final = frozenset({"lime", "carrot"})
"""Objects that no training scene has."""

UNSEEN_COMBINATIONS: Final = frozenset(
    {("tomato_can", "plate"), ("bell_pepper", "bowl"), ("peach", "plate"), ("tea_tin", "bowl")}
)
"""Objects and containers that training sees, but never together."""

_FIRST: Final = (
    ("sponge", "plate", "wood"),
    ("tomato_can", "bowl", "slate"),
    ("blue_box", "plate", "wood"),
    ("lime", "bowl", "slate"),
    ("tomato_can", "plate", "wood"),
)
"""The first scenes that there were: their indices are in datasets."""


def _make_scenes() -> tuple[Scene, ...]:
    """Return every object with every container on every table. Datasets store indices: append only."""
    every = product(OBJECTS, CONTAINERS, TABLES)
    rows = [*_FIRST, *(row for row in every if row not in _FIRST)]
    return tuple(Scene(index, *row, split=_split(*row[:2])) for index, row in enumerate(rows))


def _split(object_name: str, container: str) -> Split:
    held_out = object_name in UNSEEN_OBJECTS or (object_name, container) in UNSEEN_COMBINATIONS
    return "ood" if held_out else "ind"


SCENES: Final = _make_scenes()
"""Eighty scenes, sixteen of them held out."""


def scenes_of(split: str, scenes: Sequence[int] | None = None) -> tuple[Scene, ...]:
    """Return the scenes of a split, or those with the indices `scenes`, which must belong to it.

    Raises:
        FieldError: if the split is unknown, or a scene does not belong to it.
    """
    if split not in SPLITS:
        raise FieldError("split", split, f"unknown; choose one of {', '.join(SPLITS)}")
    members = {scene.index: scene for scene in SCENES if scene.split == split}
    if scenes is None:
        return tuple(members.values())
    unknown = [index for index in scenes if index not in members]
    if unknown or not scenes:
        raise FieldError(
            "scenes",
            list(scenes),
            f"the split {split!r} has {sorted(members)}",
            "lerobot-wmrl-record --list_scenes=true shows them",
        )
    return tuple(members[index] for index in scenes)


def with_meshes(scenes: Sequence[Scene], meshes: Mapping[str, ObjectSpec]) -> tuple[Scene, ...]:
    """Return scenes with a user's meshes in place of the objects that are named like them."""
    return tuple(replace(scene, mesh=meshes.get(scene.object)) for scene in scenes)


def scene_for_seed(scenes: Sequence[Scene], seed: int) -> Scene:
    """Return the scene of an episode seed: consecutive seeds visit `scenes` in turn."""
    return scenes[seed % len(scenes)]


def describe_scenes() -> str:
    """Return the table of scenes as text, one scene a line."""
    rows = [("index", "object", "container", "table", "split")]
    rows += [(str(s.index), s.object, s.container, s.table, s.split) for s in SCENES]
    return "\n".join("  ".join(f"{cell:<10}" for cell in row).rstrip() for row in rows)
