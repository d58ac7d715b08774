"""Checkpoints of policies, with adapters (PEFT) or without, loaded to act in an environment."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig as AdapterSettings
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_wmrl.common.checkpoints import (
    ADAPTERS_FILE,
    given_revision,
    local_model_folder,
    settled_folder,
)
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.files import whole_folder


def read_policy_config(path: str, overrides: list[str]) -> PreTrainedConfig:
    """Read the configuration of a policy's checkpoint.

    What is loaded afterwards is the checkpoint that was there now: of a training the last one, of a name on
    the hub with `pretrained_revision` that revision, which is downloaded into the cache.

    Raises:
        FieldError: there is no checkpoint, or none with these settings.
    """
    folder, revision = settled_folder(path), given_revision(overrides)
    if revision and folder.exists():
        raise FieldError(
            "policy.pretrained_revision", revision, f"{path} is a folder, and these have no revisions",
            "leave it out, or give the name of a policy on the hub",
        )  # fmt: skip
    if not (folder / "config.json").is_file() and (folder.exists() or path.startswith((".", "/"))):
        raise FieldError(
            "policy.path", path, "no checkpoint there (config.json is missing)",
            "give the output folder of a policy's training, or a hub id",
        )  # fmt: skip
    try:
        if revision:
            folder = local_model_folder(path, revision=revision)
        config = PreTrainedConfig.from_pretrained(str(folder), cli_overrides=overrides)
    except SystemExit as error:  # of argparse, which has named them
        raise FieldError(
            "policy.path", path, "its policy has not all of the settings that are given beside it",
            "leave out those that the message above names",
        ) from error  # fmt: skip
    except Exception as error:  # draccus, the hub and json each raise their own
        raise FieldError(
            "policy.path", path, f"no policy can be loaded from it ({first_line(error)})",
            "give the output folder of a policy's training, or a hub id",
        ) from error  # fmt: skip
    config.pretrained_path, config.pretrained_revision = folder, None
    return config


def copy_checkpoint(config: PreTrainedConfig, folder: Path, preprocessor: Any = None) -> None:
    """Make a checkpoint that acts as `config` says, with links to its policy's weights and processors.

    A checkpoint that is there already stays. That of a name on the hub is downloaded into its cache. A
    `preprocessor` takes the place of the policy's.
    """
    if folder.exists():
        return
    source = local_model_folder(str(config.pretrained_path))
    with whole_folder(folder) as partial:
        config.save_pretrained(partial)
        if preprocessor is not None:
            preprocessor.save_pretrained(partial)
        for file in source.iterdir():
            if not (partial / file.name).exists():
                (partial / file.name).symlink_to(file.resolve())


def check_weights(config: PreTrainedConfig) -> None:
    """Raise FieldError if the weights of a checkpoint on disk are missing or truncated; do not read them."""
    if config.pretrained_path is None or not config.pretrained_path.is_dir():
        return
    try:
        with safe_open(config.pretrained_path / weights_file(config), framework="pt"):
            pass
    except (SafetensorError, OSError) as error:
        raise _unreadable(config, error) from error


def weights_file(config: PreTrainedConfig) -> str:
    """Return the name of the file with a checkpoint's trained weights."""
    return ADAPTERS_FILE if config.use_peft else SAFETENSORS_SINGLE_FILE


def load_policy(config: PreTrainedConfig) -> Any:
    """Load a policy with its weights, in evaluation mode; one without a checkpoint has none to load.

    Raises:
        FieldError: the weights do not fit.
    """
    from lerobot.policies.factory import get_policy_class

    if config.pretrained_path is None:
        return get_policy_class(config.type)(config).eval()
    try:
        if config.use_peft:
            return load_with_adapters(config).eval()
        policy_class = get_policy_class(config.type)
        return policy_class.from_pretrained(str(config.pretrained_path), config=config, strict=True)
    except torch.OutOfMemoryError:
        raise
    except (SafetensorError, RuntimeError, OSError) as error:
        raise _unreadable(config, error) from error


def load_processors(config: PreTrainedConfig) -> tuple[Any, Any]:
    """Load the checkpoint's pre- and postprocessor, on the policy's device; new ones without a checkpoint."""
    from lerobot.policies.factory import make_pre_post_processors

    if config.pretrained_path is None:
        return make_pre_post_processors(config)
    overrides = {"device_processor": {"device": config.device}}
    return make_pre_post_processors(config, str(config.pretrained_path), preprocessor_overrides=overrides)


@dataclass
class LoadedPolicy:
    """A policy with its configuration and its processors."""

    config: PreTrainedConfig
    policy: Any
    preprocessor: Any
    postprocessor: Any

    @classmethod
    def load(cls, config: PreTrainedConfig) -> "LoadedPolicy":
        """Load a policy, in evaluation mode, and its processors. FieldError if the weights do not fit."""
        return cls(config, load_policy(config), *load_processors(config))

    @property
    def processors(self) -> tuple[Any, Any]:
        """Pre- and postprocessor, in the order of LeRobot's functions."""
        return self.preprocessor, self.postprocessor

    def reset(self) -> None:
        """Forget the episodes so far."""
        for part in (self.policy, *self.processors):
            part.reset()

    @torch.no_grad()
    def act(self, observation: Observation) -> Tensor:
        """Return actions, in the dataset's units, for a batch of observations in LeRobot's names. (B, A)"""
        action: Tensor = self.postprocessor(self.policy.select_action(self.preprocessor(observation)))
        return action


def adopt_features(config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]]) -> None:
    """Let a policy that saw no dataset yet see what the environment shows, as lerobot-eval does."""
    if config.input_features:
        return
    kinds = {name: FeatureType.VISUAL if name.startswith(OBS_IMAGE) else FeatureType.STATE for name in shown}
    config.input_features = {
        name: PolicyFeature(type=kinds[name], shape=shape) for name, shape in shown.items()
    }
    config.validate_features()


def require_trained(config: PreTrainedConfig) -> None:
    """Raise FieldError for a policy without a checkpoint, unless it has nothing to train (a planner)."""
    if config.pretrained_path is None and config.get_optimizer_preset() is not None:
        raise FieldError(
            "policy.type", config.type, "would act with random weights", "give a checkpoint: `policy.path`"
        )


def require_distillable(config: PreTrainedConfig) -> None:
    """Raise FieldError for a policy that learns from what the labels of a planner lack, later observations or
    rewards, or whose actions are relative to a state that later actions of a chunk no longer have."""
    if getattr(config, "use_relative_actions", False):
        raise FieldError(
            "policy.path", config.pretrained_path, f"this {config.type} predicts relative actions",
            "take one that was trained with `use_relative_actions=false`",
        )  # fmt: skip
    ahead = max(config.observation_delta_indices or [0]) > 0
    if ahead or config.reward_delta_indices is not None:
        raise FieldError(
            "policy.path", config.pretrained_path,
            f"{config.type} learns from {'later observations' if ahead else 'rewards'}, and a planner's "
            "labels have none", "take one that is cloned from observations and actions, such as act",
        )  # fmt: skip


def require_chunks(config: PreTrainedConfig) -> None:
    """Raise FieldError for an ACT policy whose actions are averages of several chunks."""
    if config.temporal_ensemble_coeff is not None:
        raise FieldError(
            "policy.temporal_ensemble_coeff", config.temporal_ensemble_coeff,
            "averaged chunks have no log-probability", "set `policy.temporal_ensemble_coeff` to null",
        )  # fmt: skip


def fit_to_environment(
    config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]], action_size: int
) -> None:
    """Let a policy without features take the environment's; `check_fit` for all others."""
    adopt_features(config, shown)
    action = PolicyFeature(type=FeatureType.ACTION, shape=(action_size,))
    config.output_features = config.output_features or {ACTION: action}
    check_fit(config, shown, action_size)


def seen_shape(feature: PolicyFeature) -> tuple[int, ...]:
    """Return the shape of what a policy sees, images (C, H, W).

    LeRobot's feature says (H, W, 3) where the dataset calls the channels by another name, such as `rgb`.
    """
    shape = tuple(feature.shape)
    channels_last = feature.type is FeatureType.VISUAL and shape[-1] == 3 and shape[0] != 3
    return (3, *shape[:2]) if channels_last else shape


def check_fit(
    config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]], action_size: int,
    where: str = "the environment",
) -> None:  # fmt: skip
    """Raise FieldError unless an environment shows what the policy looks at, in the same sizes.

    Args:
        config: the policy's.
        shown: the environment's observations by LeRobot's names with their shapes, images (3, H, W).
        action_size: components of the environment's actions.
        where: what the error calls the environment.
    """
    cameras = ", ".join(name for name in shown if name.startswith(OBS_IMAGE)) or "none"
    path = config.pretrained_path
    for name, feature in (config.input_features or {}).items():
        if name not in shown and name != OBS_STATE and not name.startswith(OBS_IMAGE):
            raise FieldError(
                "policy.path", path,
                f"the policy needs {name}, and a policy is shown cameras and {OBS_STATE} alone",
                "train it on data without that column (lerobot-edit-dataset, remove_feature)",
            )  # fmt: skip
        if name not in shown:
            raise FieldError(
                "policy.path", path,
                f"the policy needs {name}, which {where} does not have (its cameras: {cameras})",
                "use one with the policy's cameras and state, or train the policy on what this one shows",
            )  # fmt: skip
        if shown[name] != seen_shape(feature):
            needed = f"the policy needs {name} of shape {seen_shape(feature)}"
            of_images = "use the image size that the policy was trained on"
            of_state = "use the robot that the policy was trained for, or train it on this one's data"
            raise FieldError(
                "policy.path", path, f"{needed}, {where} has {shown[name]}",
                of_images if name.startswith(OBS_IMAGE) else of_state,
            )  # fmt: skip
    if config.action_feature is None:
        raise FieldError(
            "policy.path", path, "does not say how many components an action has",
            "train it on a dataset with the environment's actions",
        )  # fmt: skip
    wanted = config.action_feature.shape[0]
    if wanted != action_size:
        raise FieldError(
            "policy.path", path, f"the policy has {wanted} action components, {where} {action_size}",
            "train it on a dataset with these actions",
        )  # fmt: skip


def check_units(
    config: PreTrainedConfig, postprocessor: Any, names: Sequence[str], low: Tensor, high: Tensor,
    where: str = "the environment",
) -> None:  # fmt: skip
    """Raise FieldError if a policy's actions are in other units than an environment's.

    This is seen from the mean of the actions that the policy was trained on: it must not lie farther outside
    of the environment's range than this is wide.

    Args:
        config: the policy's.
        postprocessor: the policy's, which knows that mean, if actions are normalised.
        names: one for each component of an action.
        low, high: the range of the environment's actions. (A,), (A,)
        where: what the error calls the environment.
    """
    for known in _action_statistics(postprocessor, "mean"):
        mean, least, most = (torch.as_tensor(each).flatten().cpu().double() for each in (*known, low, high))
        width = (most - least).clamp_min(1e-3 * most.abs())  # a constant component's mean was rounded
        strange = (mean < least - width) | (mean > most + width)
        for component in strange.nonzero().flatten().tolist()[:1]:
            raise FieldError(
                "policy.path", config.pretrained_path,
                f"was trained on actions whose {names[component]} is {mean[component]:.4g} on average, in "
                f"{where} it is between {least[component]:.4g} and {most[component]:.4g}",
                "use a policy with the same actions in the same units",
            )  # fmt: skip


def learnt_range(postprocessor: Any) -> tuple[Tensor, Tensor] | None:
    """Return the least and the greatest actions that a policy has learnt from, if its postprocessor says it.
    (A,), (A,)"""
    for low, high in _action_statistics(postprocessor, "min", "max"):
        return torch.as_tensor(low).flatten().cpu().float(), torch.as_tensor(high).flatten().cpu().float()
    return None


def _action_statistics(postprocessor: Any, *names: str) -> Iterator[list[Any]]:
    """Yield these statistics of actions from every step of a postprocessor that has them all."""
    for step in postprocessor.steps:
        stats = (getattr(step, "stats", None) or {}).get(ACTION, {})
        if all(stats.get(name) is not None for name in names):
            yield [stats[name] for name in names]


def with_new_adapters(policy: Any, settings: AdapterSettings) -> Any:
    """Add adapters to a policy as lerobot-train does. Raises FieldError if it has some already."""
    if has_adapters(policy):
        raise FieldError("peft", None, "the policy has adapters, which are trained further; leave it out")
    return policy.wrap_with_peft(peft_cli_overrides=asdict(settings))


def load_with_adapters(config: PreTrainedConfig, **options: Any) -> Any:
    """Load the policy that an adapter was trained on, with the adapter, ready to be trained further.

    Args:
        config: configuration of the checkpoint that holds the adapter.
        options: options for the policy's `from_pretrained`.

    Raises:
        ValueError: the policy that was adapted is not there.
    """
    from lerobot.policies.factory import get_policy_class
    from peft import PeftModel

    path, adapter = str(config.pretrained_path), adapter_config(config)
    base = adapter.base_model_name_or_path
    if not may_be_on_hub(base) and not Path(base).is_dir():
        raise ValueError(
            f"{path}: adapts the policy in {base}, which is not there; put it back, start this where its "
            "training was started, or write where it is now into adapter_config.json, base_model_name_or_path"
        )
    policy_class = get_policy_class(config.type)
    try:
        policy = policy_class.from_pretrained(
            base, config=config, revision=adapter.revision, strict=True, **options
        )
    except torch.OutOfMemoryError:
        raise
    except (SafetensorError, RuntimeError, OSError) as error:
        raise ValueError(
            f"{path}: adapts the policy in {base}, which cannot be read ({first_line(error)}); put back what "
            "was adapted"
        ) from error
    return PeftModel.from_pretrained(policy, path, config=adapter, is_trainable=True)


def adapter_config(config: PreTrainedConfig) -> Any:
    """Return PEFT's configuration of the adapter in a checkpoint."""
    from peft import PeftConfig

    return PeftConfig.from_pretrained(str(config.pretrained_path))


def may_be_on_hub(name: str) -> bool:
    """Return whether a name can be one of the hub's, `model` or `owner/model`. All others are paths."""
    return len(Path(name).parts) <= 2 and not name.startswith((".", "/"))


def unwrapped(policy: Any) -> Any:
    """Return the policy inside its adapters."""
    return policy.get_base_model() if has_adapters(policy) else policy


def has_adapters(policy: Any) -> bool:
    """Return whether a policy is wrapped in PEFT's adapters."""
    from peft import PeftModel

    return isinstance(policy, PeftModel)


def load_trained_weights(policy: Any, weights: dict[str, Any]) -> None:
    """Load all weights of a checkpoint, or its adapters' alone. Raises RuntimeError if they do not fit.

    Of weights that a policy uses under several names a checkpoint holds one.
    """
    from peft import set_peft_model_state_dict

    if not has_adapters(policy):
        state = policy.state_dict()
        held = {state[name].data_ptr() for name in weights if name in state}
        tied = {name: state[name] for name in state.keys() - weights.keys() if state[name].data_ptr() in held}
        policy.load_state_dict({**tied, **weights})
        return
    unexpected = set_peft_model_state_dict(policy, weights).unexpected_keys
    if unexpected:
        raise RuntimeError(f"the adapters do not fit the policy: {unexpected[0]} is unknown")


def _unreadable(config: PreTrainedConfig, error: Exception) -> FieldError:
    return FieldError(
        "policy.path", config.pretrained_path,
        f"{weights_file(config)} cannot be read ({first_line(error)})",
        "it is missing, truncated or of another version: use an earlier checkpoint or train again",
    )  # fmt: skip
