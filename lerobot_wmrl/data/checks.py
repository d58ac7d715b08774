"""What a dataset must have for a model: cameras, depth, widths, statistics, success that is shown."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import OBS_IMAGES

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.lerobot_commands import edit_advice
from lerobot_wmrl.data.episodes import EpisodeTable, success_column


def frame_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """Return (H, W) of a camera's feature, whose shape is (H, W, 3) or (3, H, W).

    Its names say which, if one of them is that of the channels; else the shape does.
    """
    shape, names = tuple(feature["shape"]), feature.get("names") or ()
    channels = [axis for axis, name in enumerate(names) if str(name).startswith("channel")]
    first = channels[0] == 0 if channels else shape[0] in (1, 3) and shape[-1] not in (1, 3)
    height, width = shape[1:] if first else shape[:2]
    return height, width


def shows_colours(feature: Mapping[str, Any]) -> bool:
    """Return whether a feature is a camera's, and not its depth (as LeRobot's `depth_keys` tell)."""
    notes = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    depth = notes.get("is_depth_map") or notes.get("video.is_depth_map")
    return feature["dtype"] in ("image", "video") and not depth


def check_cameras(meta: Any, camera_keys: Sequence[str], field: str | None = None) -> None:
    """Raise FieldError unless a dataset has these cameras.

    Args:
        meta: the dataset's metadata, a LeRobotDatasetMetadata.
        camera_keys: the cameras.
        field: the setting that names them, which the error is about; None: a trained model has learnt them,
            and the dataset is another one.
    """
    features = meta.features
    coloured = [name for name, feature in features.items() if shows_colours(feature)]
    for key in camera_keys:
        if key not in coloured:
            cameras = ", ".join(coloured) or "none"
            problem = f"the dataset has no {key} (its cameras: {cameras})"
            if field is None:
                raise FieldError(
                    "dataset.root", meta.root, f"{problem}, which the model looks at", "use one that has it"
                )
            raise FieldError(
                field,
                camera_names(camera_keys),
                problem,
                f"set `{field}` to match, or use a dataset with this camera",
            )


def camera_names(camera_keys: Sequence[str]) -> list[str]:
    """Return the cameras' names without the prefix of their keys."""
    return [key.removeprefix(f"{OBS_IMAGES}.") for key in camera_keys]


def depth_key(camera_key: str) -> str:
    """Return the dataset's key of a camera's depth."""
    return f"{camera_key}_depth"


def check_depth(features: Mapping[str, Any], camera_keys: Sequence[str]) -> None:
    """Raise FieldError unless the dataset has the depth of these cameras."""
    for key in map(depth_key, camera_keys):
        if key not in features:
            raise FieldError(
                "depth",
                True,
                f"the world model looks at {key}, which the dataset lacks",
                "record it with lerobot-wmrl-record --depth=true",
            )


def require_shown(table: EpisodeTable, episodes: Iterable[int]) -> None:
    """Raise FieldError if episodes succeed and none of their frames shows it."""
    if not table.shows_success(episodes):
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            f"{success_column(table.dataset.features)} is true in the last rows of episodes alone, and the "
            "frame after the last action is not recorded: no frame shows success",
            "label it anew: lerobot-wmrl-label with --success.type=ends takes the last frames for solved",
        )


def check_widths(meta: Any, wanted: Mapping[str, int]) -> None:
    """Raise FieldError unless a dataset's features have as many components as a model was trained with, 0 for
    any. meta: its metadata, a LeRobotDatasetMetadata."""
    for name, width in wanted.items():
        size = meta.features[name]["shape"][0] if name in meta.features else 0
        if width and size != width:
            raise FieldError(
                "dataset.root",
                meta.root,
                f"{name}: the world model was trained with {width} components, the dataset has "
                f"{size or 'none'}",
                "use a dataset like the one it was trained on",
            )


def check_statistics(meta: Any, key: str) -> None:
    """Raise FieldError unless a dataset's statistics of a feature are a finite number for each component."""
    size = int(np.prod(meta.features[key]["shape"]))
    for name in ("mean", "std"):
        values = np.asarray((meta.stats or {}).get(key, {}).get(name, ()), np.float64).reshape(-1)
        if len(values) != size or not np.isfinite(values).all():
            raise FieldError(
                "dataset.root",
                meta.root,
                f"its statistics (meta/stats.json) say that the {name} of {key} is {values.tolist()}, where "
                f"{size} finite numbers should be",
                f"compute them again: {edit_advice(meta.root, 'recompute_stats', {})}",
            )


def solved_from_the_start(table: EpisodeTable) -> str | None:
    """Say so if most successes hold from their episodes' first frames on: whole episodes were labelled."""
    first = table.done[table.start[table.success]]
    if not first.size or 2 * first.sum() <= first.size:
        return None
    return (
        f"success holds from the first frame on in {first.sum()} of {first.size} successful episodes, so "
        "imagined episodes will succeed at once. Labels are of frames: lerobot-wmrl-label "
        "--success.type=ends --success.episodes=[…] says which episodes are solved at their ends"
    )


def check_episode_lengths(root: Path, episodes: int, frames: int) -> None:
    """Raise FieldError if none of the episodes, which have so many frames in all, has a second one to
    predict."""
    if frames <= episodes:
        raise FieldError(
            "dataset.root",
            root,
            f"{episodes} episodes to learn from, of {frames} frames in all",
            "a world model learns from episodes of two frames or more: record longer ones, or choose others",
        )
