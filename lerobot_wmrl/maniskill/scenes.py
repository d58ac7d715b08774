"""The table of scenes: object x container x table, and which training may see. Imports no simulator."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

Split = Literal["ind", "ood"]
SPLITS: Final[tuple[str, ...]] = get_args(Split)


@dataclass(frozen=True)
class Scene:
    """One scene. `split` is "ind" (in-domain: recorded and trained on) or "ood" (held out).

    An "ood" scene has either an object that no "ind" scene has, or a new combination of known things.
    """

    index: int
    object: str
    container: str
    table: str
    split: Split


_ROWS: Final[tuple[tuple[str, str, str, Split], ...]] = (
    ("sponge", "plate", "wood", "ind"),
    ("tomato_can", "bowl", "slate", "ind"),
    ("blue_box", "plate", "wood", "ind"),
    ("lime", "bowl", "slate", "ood"),
    ("tomato_can", "plate", "wood", "ood"),
)
SCENES: Final = tuple(Scene(index, *row) for index, row in enumerate(_ROWS))
"""Append only: the index is stored in datasets as `start.scene`."""


def scenes_of(split: str, scenes: Sequence[int] | None = None) -> tuple[Scene, ...]:
    """The scenes of a split, or those of `scenes` (indices), all of that split. ValueError otherwise."""
    if split not in SPLITS:
        raise ValueError(f"split={split!r} is unknown; choose one of {', '.join(SPLITS)}")
    members = {scene.index: scene for scene in SCENES if scene.split == split}
    if scenes is None:
        return tuple(members.values())
    unknown = [index for index in scenes if index not in members]
    if unknown or not scenes:
        raise ValueError(
            f"scenes={list(scenes)}: the split {split!r} has {sorted(members)} (see --list_scenes=true)"
        )
    return tuple(members[index] for index in scenes)


def scene_for_seed(scenes: Sequence[Scene], seed: int) -> Scene:
    """The scene of an episode seed: consecutive seeds visit `scenes` in turn."""
    return scenes[seed % len(scenes)]


def describe_scenes() -> str:
    """The table as text, one scene a line."""
    rows = [("index", "object", "container", "table", "split")]
    rows += [(str(s.index), s.object, s.container, s.table, s.split) for s in SCENES]
    return "\n".join("  ".join(f"{cell:<10}" for cell in row).rstrip() for row in rows)
