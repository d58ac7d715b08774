"""The columns of recorded episodes as LeRobot describes them: those of a robot, or like another dataset's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.io_utils import load_info, write_info
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, OBS_IMAGE, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import to_pixels
from lerobot_wmrl.data.checks import shows_colours
from lerobot_wmrl.data.embodiment import HIGH, LOW, Embodiment

EARLIER_NOTE, DEPTH_NOTE = "video.is_depth_map", "is_depth_map"
"""What LeRobot called the note that a video shows depth, and what it calls it today."""


def episode_features(observation: Observation, robot: Embodiment, camera: str) -> dict[str, dict[str, Any]]:
    """Describe the columns of what a robot does: a batch of its observations, actions, reward and success.

    camera: how images are stored, image or video.
    """
    flag, number = ({"dtype": kind, "shape": (1,), "names": None} for kind in ("bool", "float32"))
    return {
        **observation_features(observation, robot.state_names, camera),
        ACTION: {
            "dtype": "float32",
            "shape": (len(robot.action_names),),
            "names": robot.action_names,
            "info": {LOW: robot.action_low, HIGH: robot.action_high},
        },
        "next.reward": number,
        "next.success": flag,
        "next.done": flag,
    }


def observation_row(observation: Observation, row: int) -> dict[str, np.ndarray]:
    """Return one row of a batch of observations as a dataset holds it: images (H, W, 3) uint8.

    Images of the batch are in [0, 1], or uint8 already.
    """
    return {
        key: to_pixels(value[row])
        if key.startswith(OBS_IMAGE)
        else value[row].cpu().numpy().astype(np.float32)
        for key, value in observation.items()
        if isinstance(value, Tensor)
    }


def observation_features(
    observation: Observation, state_names: Sequence[str], camera: str
) -> dict[str, dict[str, Any]]:
    """Describe the columns of a batch of observations; `camera` is how images are stored, image or video."""
    features: dict[str, dict[str, Any]] = {}
    for key, value in observation.items():
        if not isinstance(value, Tensor):
            continue
        if key.startswith(OBS_IMAGE):
            _, channels, height, width = value.shape
            shape = (height, width, channels)
            features[key] = {"dtype": camera, "shape": shape, "names": ["height", "width", "channels"]}
        else:
            names = list(state_names) if key == OBS_STATE and state_names else None
            features[key] = {"dtype": "float32", "shape": tuple(value.shape[1:]), "names": names}
    return features


def matched(recorded: Mapping[str, Any], columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return the features with which a recording, `recorded`, can be merged with a dataset of `columns`.

    Numbers are recorded in the dataset's type (`row_in`), if that holds them.

    Raises:
        FieldError: the dataset has a column that a rollout lacks, or has in another shape or kind.
    """
    wanted = {name: dict(feature) for name, feature in columns.items() if name not in DEFAULT_FEATURES}
    for name, feature in wanted.items():
        found = recorded.get(name)
        actual, needed = _kept_as(found), _kept_as(feature)
        if actual != needed and not (found and _holds(feature, found)):
            raise FieldError(
                "like.root",
                name,
                f"the dataset has it as {needed}, a rollout has {actual}",
                "give `like_columns=false`, and the recording as `dataset.more` to what learns from it",
            )
        if "info" in feature and feature["dtype"] == "video":
            feature.pop("info")  # the encoder's, which LeRobot writes
    return wanted


def row_in(features: Mapping[str, Any], row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row's values of the columns that a dataset has, numbers in its types."""
    return {
        name: np.asarray(value, features[name]["dtype"]) if _is_number(features[name]) else value
        for name, value in row.items()
        if name in features
    }


def _is_number(feature: Mapping[str, Any]) -> bool:
    return str(feature["dtype"]).startswith(("bool", "int", "uint", "float"))


def _holds(feature: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether a column of numbers can hold another: whole ones hold no fractions, and flags no numbers."""
    return (
        _is_number(feature)
        and _is_number(other)
        and tuple(feature["shape"]) == tuple(other["shape"])
        and np.can_cast(
            other["dtype"],
            feature["dtype"],
            "same_kind" if str(other["dtype"]).startswith("float") else "safe",
        )
    )


def _kept_as(feature: Mapping[str, Any] | None) -> str:
    """`float32 of shape (7,)`. Images may be stored one by one or as video."""
    if feature is None:
        return "none"
    kind = "images" if feature["dtype"] in ("image", "video") else feature["dtype"]
    return f"{kind} of shape {tuple(feature['shape'])}"


def video_info(feature: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a dataset, also of an earlier version, says of its videos."""
    return feature.get("info") or feature.get("video_info") or {}


def encoder_of(columns: Mapping[str, Any]) -> RGBEncoderConfig | None:
    """Return the encoder of a dataset's videos, with which others can be merged; None if it has none."""
    videos = [each for each in columns.values() if each["dtype"] == "video" and shows_colours(each)]
    return RGBEncoderConfig.from_video_info(video_info(videos[0])) if videos else None


def name_notes_anew(root: Path) -> None:
    """Give the note that says whether a dataset's videos show depth the name that LeRobot has for it today.

    Earlier versions called it otherwise, and LeRobot merges no datasets that differ in it.
    """
    info = load_info(root)
    for feature in info.features.values():
        notes = feature.get("info") or {}
        if EARLIER_NOTE in notes:
            notes[DEPTH_NOTE] = notes.pop(EARLIER_NOTE)
    write_info(info, root)


def describe_alike(root: Path, columns: Mapping[str, Any]) -> None:
    """Describe the columns of a whole recording as another dataset does, word for word.

    LeRobot merges no datasets whose descriptions differ, be it in notes of an earlier version. Videos that
    are encoded in another way keep theirs: they must not be merged.
    """

    def encoding(feature: Mapping[str, Any]) -> list[Any]:
        return [video_info(feature).get(f"video.{name}") for name in ("codec", "pix_fmt")]

    info = load_info(root)
    for name, feature in info.features.items():
        if feature["dtype"] != "video" or encoding(feature) == encoding(columns[name]):
            info.features[name] = dict(columns[name])
    write_info(info, root)
