"""Whether a dataset has what a model looks at."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_wmrl.common.errors import FieldError


def frame_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """(H, W) of a camera's feature, whose shape is (H, W, 3) or, by its names, (3, H, W)."""
    names = feature.get("names") or ("height", "width", "channels")
    height, width = feature["shape"][:2] if names[2].startswith("channel") else feature["shape"][1:]
    return height, width


def check_cameras(features: Mapping[str, Any], camera_keys: Sequence[str], image_size: int) -> None:
    """Raise FieldError unless the dataset has these cameras at that image size."""
    for key in camera_keys:
        if key not in features:
            cameras = ", ".join(name for name in features if name.startswith(OBS_IMAGES)) or "none"
            raise FieldError(
                "tokenizer.cameras", camera_names(camera_keys),
                f"the dataset has no {key} (its cameras: {cameras})",
                "set `tokenizer.cameras` to match, or use a dataset with this camera",
            )  # fmt: skip
        height, width = frame_size(features[key])
        if (height, width) != (image_size, image_size):
            raise FieldError(
                "tokenizer.image_size", image_size, f"the dataset's {key} is {height}x{width}",
                f"train a tokenizer with `tokenizer.image_size`={height} or record at {image_size}",
            )  # fmt: skip


def camera_names(camera_keys: Sequence[str]) -> list[str]:
    """Return the cameras' names without the prefix of their keys."""
    return [key.removeprefix(f"{OBS_IMAGES}.") for key in camera_keys]


def depth_key(camera_key: str) -> str:
    """Where the dataset has a camera's depth."""
    return f"{camera_key}_depth"


def check_depth(features: Mapping[str, Any], camera_keys: Sequence[str], image_size: int) -> None:
    """Raise FieldError unless the dataset has the depth of these cameras, at their image size."""
    for key in map(depth_key, camera_keys):
        found = frame_size(features[key]) if key in features else None
        if found != (image_size, image_size):
            size = "none" if found is None else f"one of {found[0]}x{found[1]}"
            raise FieldError(
                "depth", True,
                f"the world model looks at {key} of {image_size} x {image_size} pixels, the dataset has "
                f"{size}",
                "record it with lerobot-wmrl-record --depth=true",
            )  # fmt: skip


def check_dataset(config: Any, features: Mapping[str, Any]) -> None:
    """Raise ValueError unless a trained model can learn from, start in or replay the dataset's episodes."""
    sizes = config.tokenizer
    check_cameras(features, sizes.camera_keys, sizes.image_size)
    if getattr(config, "depth", False):
        check_depth(features, sizes.camera_keys, sizes.image_size)
    sizes = {OBS_STATE: getattr(config, "state_size", 0), ACTION: getattr(config, "action_size", 0)}
    for name, wanted in sizes.items():
        found = features[name]["shape"][0] if name in features else 0
        if wanted and found != wanted:
            raise ValueError(
                f"{name}: the world model was trained with {wanted} components, the dataset has "
                f"{found or 'none'}; use a dataset like the one it was trained on"
            )


def check_episode_lengths(meta: Any) -> None:
    """ValueError if no episode has a second frame to predict."""
    if meta.total_frames <= meta.total_episodes:
        raise ValueError(
            f"dataset.root={meta.root}: {meta.total_episodes} episodes of {meta.total_frames} frames in all; "
            "a world model learns from episodes of two frames or more: record longer ones"
        )


def check_same_tokenizer(model: Any, text_model: Any, flag: str) -> None:
    """ValueError unless both world models, the second given by `flag`, speak of frames in the same tokens."""
    own, other = model.tokenizer.state_dict(), text_model.tokenizer.state_dict()
    if own.keys() != other.keys() or not all(torch.equal(own[name], other[name]) for name in own):
        raise ValueError(
            f"{flag}: trained on another tokenizer than the action world model; train both with the same "
            "--model.tokenizer_path"
        )
