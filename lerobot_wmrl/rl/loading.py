"""A policy's checkpoint, loaded for training in an environment that must fit it."""

from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGES, PRETRAINED_MODEL_DIR
from safetensors import SafetensorError
from torch import Tensor

from lerobot_wmrl.checkpoints import LAST_CHECKPOINT
from lerobot_wmrl.rl.protocol import Observation, Pipeline


def policy_folder(path: str) -> str:
    """A training's output folder or one of its checkpoints → the `pretrained_model` inside; else as given."""
    root = Path(path)
    for candidate in (root, root / PRETRAINED_MODEL_DIR, root / LAST_CHECKPOINT / PRETRAINED_MODEL_DIR):
        if (candidate / "config.json").is_file():
            return str(candidate)
    return path


def read_policy_config(path: str, overrides: list[str]) -> PreTrainedConfig:
    """The configuration of a policy's checkpoint. ValueError if there is none, or it is something else."""
    folder = policy_folder(path)
    if Path(folder).exists() and not (Path(folder) / "config.json").is_file():
        raise ValueError(f"policy.path={path}: no checkpoint there (config.json is missing); train one first")
    try:
        config = PreTrainedConfig.from_pretrained(folder, cli_overrides=overrides)
    except (ValueError, FileNotFoundError, OSError) as error:
        raise ValueError(f"policy.path={path}: no policy can be loaded from it ({error})") from error
    config.pretrained_path = Path(folder)
    return config


def load_policy(config: PreTrainedConfig) -> Any:
    """The weights too, in evaluation mode. ValueError if they are truncated or of another shape."""
    policy_class = get_policy_class(config.type)
    try:
        return policy_class.from_pretrained(str(config.pretrained_path), config=config, strict=True)
    except (SafetensorError, RuntimeError, OSError) as error:
        raise ValueError(
            f"policy.path={config.pretrained_path}: model.safetensors cannot be read ({error}); it is "
            "truncated or of another version: use an earlier checkpoint or train again"
        ) from error


def load_processors(config: PreTrainedConfig) -> tuple[Any, Any]:
    """The checkpoint's pre- and postprocessor, on the policy's device."""
    overrides = {"device_processor": {"device": config.device}}
    return make_pre_post_processors(config, str(config.pretrained_path), preprocessor_overrides=overrides)


def make_pipeline(config: PreTrainedConfig, preprocessor: Any, postprocessor: Any) -> Pipeline:
    """The processors as functions; observations the policy does not know are left out."""
    known = {*(config.input_features or {}), "task"}

    def prepare(observation: Observation) -> Observation:
        return preprocessor({name: value for name, value in observation.items() if name in known})

    def to_action(raw_action: Tensor) -> Tensor:
        return postprocessor(raw_action)

    return Pipeline(prepare, to_action)


def check_fit(config: PreTrainedConfig, observation: Observation, action_size: int) -> None:
    """ValueError unless the environment shows what the policy looks at, in the same sizes."""
    shown = {
        name: tuple(value.shape[1:]) for name, value in observation.items() if isinstance(value, torch.Tensor)
    }
    cameras = ", ".join(name for name in shown if name.startswith(OBS_IMAGES)) or "none"
    for name, feature in (config.input_features or {}).items():
        if name not in shown:
            raise ValueError(
                f"policy.path={config.pretrained_path}: the policy needs {name}, which the environment does "
                f"not have (its cameras: {cameras}); use an environment made from the policy's cameras and "
                "state, or train the policy on what this one shows"
            )
        if shown[name] != tuple(feature.shape):
            raise ValueError(
                f"policy.path={config.pretrained_path}: the policy needs {name} of shape "
                f"{tuple(feature.shape)}, the environment has {shown[name]}"
            )
    wanted = (config.output_features or {})[ACTION].shape[0]
    if wanted != action_size:
        raise ValueError(
            f"policy.path={config.pretrained_path}: the policy has {wanted} action components, the "
            f"environment {action_size}"
        )
