"""Loading trained models of this package, with errors that say what is wrong and what to do."""

import json
from pathlib import Path
from typing import Any

from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import get_reward_model_class
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from safetensors import SafetensorError

from lerobot_wmrl.checkpoints import LAST_CHECKPOINT


def resolve_checkpoint(path: str | Path) -> Path:
    """A training's output folder, or one of its checkpoints → the `pretrained_model` folder inside."""
    root = Path(path)
    for candidate in (root, root / PRETRAINED_MODEL_DIR, root / LAST_CHECKPOINT / PRETRAINED_MODEL_DIR):
        if (candidate / "config.json").is_file():
            return candidate
    return root


def read_config(path: str | Path, expected_type: str, device: str = "cpu") -> RewardModelConfig:
    """The configuration of a checkpoint of exactly `expected_type`, else ValueError."""
    folder = resolve_checkpoint(path)
    if not (folder / "config.json").is_file():
        if folder.is_dir() or str(path).startswith((".", "/", "outputs")) or str(path).count("/") != 1:
            raise ValueError(
                f"{path!r}: no {expected_type} there; give the output folder of its training, or a hub id"
            )
    else:
        found = json.loads((folder / "config.json").read_text()).get("type")
        if found != expected_type:
            raise ValueError(
                f"{path}: is a checkpoint of type {found!r}, but {expected_type!r} is needed here"
            )
    return RewardModelConfig.from_pretrained(str(folder), cli_overrides=[f"--device={device}"])


def load_model(path: str | Path, expected_type: str, device: str = "cpu") -> Any:
    """Load a checkpoint of exactly `expected_type` in evaluation mode.

    Raises:
        ValueError: not found, of another type, truncated, or with other tensors than its config.
    """
    config = read_config(path, expected_type, device)
    folder = resolve_checkpoint(path)
    try:
        return get_reward_model_class(config.type).from_pretrained(str(folder), config=config, strict=True)
    except (SafetensorError, RuntimeError, OSError) as error:
        raise ValueError(
            f"{path}: model.safetensors cannot be read ({error}). It is truncated or of another version: "
            "use an earlier checkpoint or train again"
        ) from error
