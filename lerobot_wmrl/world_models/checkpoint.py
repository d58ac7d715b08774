"""Loading trained models of this package, with errors that say what is wrong and what to do."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import get_reward_model_class
from safetensors import SafetensorError

from lerobot_wmrl.common.checkpoints import resolve_checkpoint

FLAGS: Final = {
    "frame_tokenizer": "--model.tokenizer_path",
    "action_world_model": "--env.world_model_path / --model.path",
    "text_world_model": "--env.text_world_model_path / --text_model.path",
}
"""How the commands call the path of a model of each type."""


def read_config(path: str | Path, expected_type: str, device: str | None = "cpu") -> RewardModelConfig:
    """The configuration of a checkpoint of exactly `expected_type`, else ValueError. No device: the best."""
    flag = FLAGS.get(expected_type, "--env.reward.pretrained_path")
    folder = resolve_checkpoint(path)
    if not (folder / "config.json").is_file():
        if folder.is_dir() or str(path).startswith((".", "/", "outputs")) or str(path).count("/") != 1:
            raise ValueError(
                f"{flag}={path}: no {expected_type} there; give its training's output folder, or a hub id"
            )
    else:
        found = _stored_type(folder / "config.json")
        if found != expected_type:
            raise ValueError(
                f"{flag}={path}: is a checkpoint of type {found!r}, but {expected_type!r} is needed here: "
                f"give the output folder of a training with that type"
            )
    if device is None:
        accelerator = torch.accelerator.current_accelerator(check_available=True)
        device = accelerator.type if accelerator else "cpu"
    return RewardModelConfig.from_pretrained(str(folder), cli_overrides=[f"--device={device}"])


def config_to_continue(path: str, overrides: Sequence[str]) -> RewardModelConfig:
    """The settings of a trained model, `overrides` on top, to train it further (`--model.path`).

    ValueError if there is none.
    """
    folder = resolve_checkpoint(path)
    try:
        config = RewardModelConfig.from_pretrained(str(folder), cli_overrides=list(overrides))
    except Exception as error:  # draccus, the hub and json each raise their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(
            f"--model.path={path}: no model can be loaded from it ({reason}); give the output folder of a "
            "training, or a hub id"
        ) from error
    config.pretrained_path = str(folder)
    return config


def _stored_type(path: Path) -> Any:
    try:
        return json.loads(path.read_text()).get("type")
    except (json.JSONDecodeError, AttributeError) as error:
        raise ValueError(
            f"{path}: is truncated or no configuration ({error}); use an earlier checkpoint"
        ) from error


def load_model(path: str | Path, expected_type: str, device: str | None = "cpu") -> Any:
    """Load a checkpoint of exactly `expected_type` in evaluation mode. None: on the best device there is.

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


def check_same_tokenizer(model: Any, text_model: Any, flag: str) -> None:
    """ValueError unless both world models, the second given by `flag`, speak of frames in the same tokens."""
    own, other = model.tokenizer.state_dict(), text_model.tokenizer.state_dict()
    if own.keys() != other.keys() or not all(torch.equal(own[name], other[name]) for name in own):
        raise ValueError(
            f"{flag}: trained on another tokenizer than the action world model; train both with the same "
            "--model.tokenizer_path"
        )
