"""A policy's checkpoint, loaded to act in an environment that must fit it."""

from collections.abc import Mapping
from typing import Any

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_IMAGES
from safetensors import SafetensorError, safe_open

from lerobot_wmrl.common.adapters import load_with_adapters
from lerobot_wmrl.common.checkpoints import ADAPTERS_FILE, resolve_checkpoint


def read_policy_config(path: str, overrides: list[str]) -> PreTrainedConfig:
    """The configuration of a policy's checkpoint. ValueError if there is none, or it is something else."""
    folder = resolve_checkpoint(path)
    if not (folder / "config.json").is_file() and (folder.exists() or path.startswith((".", "/"))):
        raise ValueError(
            f"--policy.path={path}: no checkpoint there (config.json is missing); give the output folder of "
            "a policy's training, or a hub id"
        )
    try:
        config = PreTrainedConfig.from_pretrained(str(folder), cli_overrides=overrides)
    except Exception as error:  # draccus, the hub and json each raise their own
        raise ValueError(
            f"--policy.path={path}: no policy can be loaded from it ({_first_line(error)}); give the output "
            "folder of a policy's training, or a hub id"
        ) from error
    config.pretrained_path = folder
    return config


def check_weights(config: PreTrainedConfig) -> None:
    """ValueError if the weights of a checkpoint on disk are missing or truncated; they are not read."""
    if config.pretrained_path is None or not config.pretrained_path.is_dir():
        return
    try:
        with safe_open(config.pretrained_path / weights_file(config), framework="pt"):
            pass
    except (SafetensorError, OSError) as error:
        raise _unreadable(config, error) from error


def weights_file(config: PreTrainedConfig) -> str:
    """What the trained weights of a checkpoint are called."""
    return ADAPTERS_FILE if config.use_peft else SAFETENSORS_SINGLE_FILE


def load_policy(config: PreTrainedConfig) -> Any:
    """The weights too, in evaluation mode. ValueError if they are truncated or of another shape."""
    try:
        if config.use_peft:
            return load_with_adapters(config).eval()
        policy_class = get_policy_class(config.type)
        return policy_class.from_pretrained(str(config.pretrained_path), config=config, strict=True)
    except (SafetensorError, RuntimeError, OSError) as error:
        raise _unreadable(config, error) from error


def load_processors(config: PreTrainedConfig) -> tuple[Any, Any]:
    """The checkpoint's pre- and postprocessor, on the policy's device."""
    overrides = {"device_processor": {"device": config.device}}
    return make_pre_post_processors(config, str(config.pretrained_path), preprocessor_overrides=overrides)


def adopt_features(config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]]) -> None:
    """A policy that was never trained on a dataset sees what the environment shows, as in lerobot-eval."""
    if config.input_features:
        return
    kinds = {name: FeatureType.VISUAL if name.startswith(OBS_IMAGES) else FeatureType.STATE for name in shown}
    config.input_features = {
        name: PolicyFeature(type=kinds[name], shape=shape) for name, shape in shown.items()
    }
    config.validate_features()


def check_fit(config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]], action_size: int) -> None:
    """ValueError unless an environment shows what the policy looks at, in the same sizes.

    `shown`: the environment's observations by LeRobot's names with their shapes, images (3, H, W).
    """
    cameras = ", ".join(name for name in shown if name.startswith(OBS_IMAGES)) or "none"
    where = f"--policy.path={config.pretrained_path}"
    for name, feature in (config.input_features or {}).items():
        if name not in shown:
            raise ValueError(
                f"{where}: the policy needs {name}, which the environment does not have (its cameras: "
                f"{cameras}); use an environment made from the policy's cameras and state, or train the "
                "policy on what this one shows"
            )
        if shown[name] != tuple(feature.shape):
            raise ValueError(
                f"{where}: the policy needs {name} of shape {tuple(feature.shape)}, the environment has "
                f"{shown[name]}; use the image size that the policy was trained on"
            )
    if config.action_feature is None:
        raise ValueError(
            f"{where}: does not say how many components an action has; train it on a dataset with the "
            "environment's actions"
        )
    wanted = config.action_feature.shape[0]
    if wanted != action_size:
        raise ValueError(
            f"{where}: the policy has {wanted} action components, the environment {action_size}; train it "
            "on a dataset with the environment's actions"
        )


def _unreadable(config: PreTrainedConfig, error: Exception) -> ValueError:
    return ValueError(
        f"--policy.path={config.pretrained_path}: {weights_file(config)} cannot be read "
        f"({_first_line(error)}); it is missing, truncated or of another version: use an earlier checkpoint "
        "or train again"
    )


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
