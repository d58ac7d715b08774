"""Whether a dataset has what a model looks at."""

from collections.abc import Mapping
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE


def frame_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """(H, W) of a camera's feature, whose shape is (H, W, 3) or, by its names, (3, H, W)."""
    names = feature.get("names") or ("height", "width", "channels")
    height, width = feature["shape"][:2] if names[2].startswith("channel") else feature["shape"][1:]
    return height, width


def check_cameras(config: Any, features: Mapping[str, Any]) -> None:
    """ValueError unless the dataset has the config's cameras at its image size."""
    for key in config.camera_keys:
        if key not in features:
            cameras = ", ".join(name for name in features if name.startswith(OBS_IMAGES)) or "none"
            raise ValueError(
                f"cameras={config.cameras}: the dataset has no {key} (its cameras: {cameras}); set "
                "--model.cameras to match, or use a dataset with this camera"
            )
        height, width = frame_size(features[key])
        if (height, width) != (config.image_size, config.image_size):
            raise ValueError(
                f"image_size={config.image_size}: the dataset's {key} is {height}x{width}; "
                f"train a tokenizer with --model.image_size={height} or record at {config.image_size}"
            )
    if getattr(config, "depth", False):
        check_depth(config, features)


def depth_key(camera_key: str) -> str:
    """Where the dataset has a camera's depth."""
    return f"{camera_key}_depth"


def check_depth(config: Any, features: Mapping[str, Any]) -> None:
    """ValueError unless the dataset has the depth of the config's cameras, at their image size."""
    for key in map(depth_key, config.camera_keys):
        found = frame_size(features[key]) if key in features else None
        if found != (config.image_size, config.image_size):
            size = "none" if found is None else f"one of {found[0]}x{found[1]}"
            raise ValueError(
                f"--model.depth=true: the world model looks at {key} of {config.image_size} x "
                f"{config.image_size} pixels, the dataset has {size}; record it with "
                "lerobot-wmrl-record --depth=true"
            )


def check_dataset(config: Any, features: Mapping[str, Any]) -> None:
    """ValueError unless a trained model can learn from, start in or replay the dataset's episodes."""
    check_cameras(config, features)
    sizes = {OBS_STATE: getattr(config, "state_size", 0), ACTION: getattr(config, "action_size", 0)}
    for name, wanted in sizes.items():
        found = features[name]["shape"][0] if name in features else 0
        if wanted and found != wanted:
            raise ValueError(
                f"{name}: the world model was trained with {wanted} components, the dataset has "
                f"{found or 'none'}; use a dataset like the one it was trained on"
            )


def check_tokenizer_source(config: Any) -> None:
    """ValueError unless a world model that is to be trained gets its codes from exactly one place."""
    if config.tokenizer_path and config.pretrained_path:
        raise ValueError(
            f"--model.tokenizer_path={config.tokenizer_path}: the world model at {config.pretrained_path} "
            "carries the tokenizer whose codes it has learnt; leave one of the two out"
        )
    if not config.tokenizer_path and not config.pretrained_path:
        raise ValueError(
            "--model.tokenizer_path is missing (--reward_model.tokenizer_path in lerobot-train): give the "
            "output folder of a training with type=frame_tokenizer"
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
