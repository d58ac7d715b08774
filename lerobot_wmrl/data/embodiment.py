"""The robot that a dataset shows: names of its actions and states, the range of its actions, frames a second.

A world model keeps this in its checkpoint. Environment, planner and evaluation take it from there.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.episodes import parquet_files, read_vectors

POSITION_NAMES: Final = ("tcp_x", "tcp_y", "tcp_z")
"""First components of a state that begins with the position of the tool centre point (TCP, m)."""

LOW, HIGH = "low", "high"
"""Keys of the recorded range of a feature, lists of one number a component, in the feature's `info`."""

QUANTILES: Final = (0.01, 0.99)
"""Quantiles of the actions between which the most of them lie."""

ISOLATED: Final = 0.001
"""Share of the values, at each end, that may be wrong ones. What is more frequent is a rare action."""

FEW: Final = 3
"""The least number of such values."""

MARGIN: Final = 0.1
"""How far the range may reach beyond what is certain, as a share of the distance between the quantiles."""


@dataclass
class Embodiment:
    """The robot that a world model learns from, filled in from the dataset.

    Args:
        fps: frames a second.
        action_names: one name for each component of `action`.
        action_low: least value of each component, in the dataset's units. By default what the dataset says
            (`low` and `high` in the `info` of its feature `action`), else the least recorded one, without
            the few that lie far from all others.
        action_high: greatest value of each component, correspondingly.
        state_names: one name for each component of `observation.state`.
    """

    fps: int = 0
    action_names: list[str] = field(default_factory=list)
    action_low: list[float] = field(default_factory=list)
    action_high: list[float] = field(default_factory=list)
    state_names: list[str] = field(default_factory=list)

    def range_text(self) -> str:
        """Return the names of the action's components with their ranges."""
        parts = zip(self.action_names, self.action_low, self.action_high, strict=True)
        return ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, low, high in parts)


def component_names(feature: Mapping[str, Any]) -> list[str]:
    """Return one name for each component of a feature, their numbers where the dataset has no names.

    LeRobot's datasets have a list of names, a dictionary with such lists ({"motors": […]}), or one whose keys
    are the names.
    """
    size, names = int(np.prod(feature["shape"])), feature.get("names")
    if isinstance(names, Mapping):
        lists = [part for part in names.values() if isinstance(part, list)]
        names = [name for part in lists for name in part] or list(names)
    if not isinstance(names, Sequence) or len(names) != size:
        return [str(component) for component in range(size)]
    return [str(name) for name in names]


def read_embodiment(meta: Any, given: Embodiment, episodes: Sequence[int] | None = None) -> Embodiment:
    """Read what a dataset says about its robot.

    Args:
        meta: the dataset's metadata, a LeRobotDatasetMetadata.
        given: the user's settings; the action's range is taken from here where it is given.
        episodes: those whose actions tell the range where nothing else does, all if None.

    Raises:
        FieldError: the range that is given or recorded has another number of components, is not finite, or
            has a lower end above the upper one; or the frame rate is no whole number.
    """
    names = component_names(meta.features[ACTION])
    recorded = recorded_range(meta.features[ACTION])
    low, high, source = given.action_low, given.action_high, "settings"
    if bool(low) != bool(high):
        raise FieldError(
            "embodiment.action_low",
            low,
            f"is given without the other end (action_high={high})",
            "give both, or neither",
        )
    if not low and recorded is not None:
        (low, high), source = recorded, "dataset"
    if not low:
        (low, high), source = observed_range(meta, episodes), "recorded actions"
    check_range(low, high, names, "action.info.{}" if source == "dataset" else "embodiment.action_{}")
    embodiment = replace(
        given,
        fps=whole_rate(meta.fps, "dataset.root", meta.root),
        action_names=names,
        action_low=list(low),
        action_high=list(high),
        state_names=component_names(meta.features[OBS_STATE]) if OBS_STATE in meta.features else [],
    )
    logging.info("range of the actions, from the %s: %s", source, embodiment.range_text())
    return embodiment


def whole_rate(rate: float, field: str, value: object) -> int:
    """Return a dataset's frame rate as the whole number that it is.

    LeRobot converted older datasets to 30.0 frames a second for a time. FieldError for 29.97, of `field`.
    """
    if rate != round(rate):
        raise FieldError(
            field,
            value,
            f"has {rate} frames a second, which is no whole number",
            "record or convert it at a rate that is",
        )
    return round(rate)


def recorded_range(feature: Mapping[str, Any]) -> tuple[list[float], list[float]] | None:
    """Return the ends of the action's range, None where the dataset does not say.

    Raises:
        FieldError: one end is missing, or is no list of numbers.
    """
    info = feature.get("info") or {}
    if LOW not in info and HIGH not in info:
        return None
    for name in (LOW, HIGH):
        end = info.get(name)
        if not isinstance(end, Sequence) or not all(isinstance(each, int | float) for each in end):
            raise FieldError(
                f"action.info.{name}",
                end,
                "must be a list of numbers, one for each component, as must be the other end",
                "correct it in the dataset's meta/info.json, or leave both ends out",
            )
    return list(map(float, info[LOW])), list(map(float, info[HIGH]))


def observed_range(meta: Any, episodes: Sequence[int] | None = None) -> tuple[list[float], list[float]]:
    """Guess the range of each component from the recorded actions of some episodes, all if None.

    It is that of the recorded values but the few greatest and least (`ISOLATED`), which may be wrong and
    would widen it at will: it reaches as far as these, but not beyond the others by more than a tenth of the
    distance between the 1 % and the 99 % quantile. A component whose quantiles are the same, such as a
    gripper that hardly ever moves, keeps its extremes.
    """
    if not parquet_files(Path(meta.root)):
        raise FieldError(
            "dataset.root",
            meta.root,
            "has no files of data here, which say in what range its actions are",
            "download it: leave out `--dataset.streaming`",
        )
    actions = read_vectors(Path(meta.root), ACTION, episodes)
    finite = actions[np.isfinite(actions).all(1)]
    if not len(finite):
        raise FieldError("dataset.root", meta.root, "none of its actions is finite", "record it again")
    least, most = finite.min(0), finite.max(0)
    low, high = np.quantile(finite, QUANTILES, axis=0)
    margin = np.where(high > low, MARGIN * (high - low), np.inf)
    few = max(FEW, int(ISOLATED * len(finite)))
    if few < len(finite):
        ordered = np.sort(finite, axis=0)
        low, high = np.minimum(low, ordered[few]), np.maximum(high, ordered[-1 - few])
    low, high = np.maximum(least, low - margin), np.minimum(most, high + margin)
    names = component_names(meta.features[ACTION])
    for component in np.flatnonzero((least < low) | (most > high)).tolist():
        logging.warning(
            "action %s: %d of %d recorded values lie outside of the range that is taken, %.4g to %.4g (they "
            "reach from %.4g to %.4g). If they are meant, write the range into meta/info.json: lists `low` "
            "and `high` in the `info` of the feature `action`",
            names[component],
            ((finite < low) | (finite > high)).sum(0)[component],
            len(finite),
            low[component],
            high[component],
            least[component],
            most[component],
        )
    return low.tolist(), high.tolist()


def check_range(
    low: Sequence[float], high: Sequence[float], names: Sequence[str], setting: str = "embodiment.action_{}"
) -> None:
    """Raise FieldError unless the ends are finite, in order, and one for each component.

    setting: name of each end, `low` and `high`.
    """
    for name, end in ((LOW, low), (HIGH, high)):
        if len(end) != len(names):
            raise FieldError(
                setting.format(name),
                list(end),
                f"the dataset's action has {len(names)} components: {', '.join(names)}",
                "give one number for each",
            )
    for name, least, most in zip(names, low, high, strict=True):
        if not (np.isfinite([least, most]).all() and least <= most):
            raise FieldError(
                setting.format(LOW),
                list(low),
                f"{name} would range from {least} to {most}",
                "give finite numbers, the lower end first",
            )


def check_same_robot(embodiment: Embodiment, meta: Any) -> None:
    """Raise FieldError if a dataset shows another robot, or another frame rate, than a world model learnt.

    Names that are numbers say nothing: of them, only how many there are is compared.
    """
    for column, names in ((ACTION, embodiment.action_names), (OBS_STATE, embodiment.state_names)):
        parts = component_names(meta.features[column]) if column in meta.features else []
        unnamed = any(each.isdecimal() for each in (*parts[:1], *names[:1]))
        if names and parts and (len(names) != len(parts) if unnamed else names != parts):
            raise FieldError(
                "dataset.root",
                meta.root,
                f"its {column} has the components {', '.join(parts)}, the world "
                f"model has learnt {', '.join(names)}",
                "use a dataset of the same robot",
            )
    if embodiment.fps and embodiment.fps != meta.fps:
        raise FieldError(
            "dataset.root",
            meta.root,
            f"has {meta.fps} frames a second, the world model has learnt {embodiment.fps}",
            "use a dataset of the same frame rate",
        )
