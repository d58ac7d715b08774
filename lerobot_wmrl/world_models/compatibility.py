"""Whether a dataset has what a model looks at."""

from collections.abc import Mapping
from typing import Any

from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE


def check_cameras(config: Any, features: Mapping[str, Any]) -> None:
    """ValueError unless the dataset has the config's cameras at its image size."""
    for key in config.camera_keys:
        if key not in features:
            cameras = ", ".join(name for name in features if name.startswith(OBS_IMAGES)) or "none"
            raise ValueError(
                f"cameras={config.cameras}: the dataset has no {key} (its cameras: {cameras}); set "
                "--model.cameras to match, or use a dataset with this camera"
            )
        height, width = features[key]["shape"][:2]
        if (height, width) != (config.image_size, config.image_size):
            raise ValueError(
                f"image_size={config.image_size}: the dataset's {key} is {height}x{width}; "
                f"train a tokenizer with --model.image_size={height} or record at {config.image_size}"
            )


def check_dataset(config: Any, features: Mapping[str, Any]) -> None:
    """ValueError unless a trained world model can start in, or replay, the dataset's episodes."""
    check_cameras(config, features)
    sizes = {OBS_STATE: config.state_size, ACTION: getattr(config, "action_size", 0)}
    for name, wanted in sizes.items():
        found = features[name]["shape"][0] if name in features else 0
        if wanted and found != wanted:
            raise ValueError(
                f"{name}: the world model was trained with {wanted} components, the dataset has "
                f"{found or 'none'}; use a dataset like the one it was trained on"
            )
