"""Checkpoints of policies, with adapters (PEFT) or without, loaded to act in an environment."""

import copy
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig as AdapterSettings
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_wmrl.common.checkpoints import (
    ADAPTERS_FILE,
    given_revision,
    local_model_folder,
    may_be_on_hub,
    reading_weights,
    settled_folder,
)
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.files import whole_folder
from lerobot_wmrl.common.hub import published_name


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
            "policy.pretrained_revision",
            revision,
            f"{path} is a folder, and these have no revisions",
            "leave it out, or give the name of a policy on the hub",
        )
    if not (folder / "config.json").is_file() and (folder.exists() or not may_be_on_hub(path)):
        raise FieldError(
            "policy.path",
            path,
            "no checkpoint there (config.json is missing)",
            "give the output folder of a policy's training, or a hub id",
        )
    try:
        if revision:
            folder = local_model_folder(path, revision=revision)
        config = PreTrainedConfig.from_pretrained(str(folder), cli_overrides=overrides)
    except SystemExit as error:  # of argparse, which has named them
        raise FieldError(
            "policy.path",
            path,
            "its policy has not all of the settings that are given beside it",
            "leave out those that the message above names",
        ) from error
    except Exception as error:  # draccus, the hub and json each raise their own
        raise FieldError(
            "policy.path",
            path,
            f"no policy can be loaded from it ({first_line(error)})",
            "give the output folder of a policy's training, or a hub id",
        ) from error
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
        raise unreadable_policy(config, error) from error


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
    with reading_weights(partial(unreadable_policy, config)):
        if config.use_peft:
            return load_with_adapters(config).eval()
        policy_class = get_policy_class(config.type)
        return policy_class.from_pretrained(str(config.pretrained_path), config=config, strict=True)


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


def with_new_adapters(policy: Any, settings: AdapterSettings) -> Any:
    """Add adapters to a policy as lerobot-train does. Raises FieldError if it has some already."""
    if has_adapters(policy):
        raise FieldError("peft", None, "the policy has adapters, which are trained further; leave it out")
    adapted = policy.wrap_with_peft(peft_cli_overrides=asdict(settings))
    if published := published_name(str(policy.config.pretrained_path)):
        adapter = adapted.peft_config[adapted.active_adapter]
        adapter.base_model_name_or_path, adapter.revision = published
    return adapted


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

    def described(error: Exception) -> ValueError:
        return ValueError(
            f"{path}: adapts the policy in {base}, which cannot be read ({first_line(error)}); put back what "
            "was adapted"
        )

    policy_class = get_policy_class(config.type)
    with reading_weights(described):
        policy = policy_class.from_pretrained(
            base, config=config, revision=adapter.revision, strict=True, **options
        )
    return PeftModel.from_pretrained(policy, path, config=adapter, is_trainable=True)


def adapter_config(config: PreTrainedConfig) -> Any:
    """Return PEFT's configuration of the adapter in a checkpoint."""
    from peft import PeftConfig

    return PeftConfig.from_pretrained(str(config.pretrained_path))


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


def unreadable_policy(config: PreTrainedConfig, error: Exception) -> FieldError:
    """Return the error for a checkpoint whose weights cannot be loaded."""
    return FieldError(
        "policy.path",
        config.pretrained_path,
        f"{weights_file(config)} cannot be read ({first_line(error)})",
        "it is missing, truncated or of another version: use an earlier checkpoint or train again",
    )


def frozen_copy(policy: Any) -> Any:
    """Return a copy that is not trained. It shares the parameters that the policy does not train either, such
    as a large network under LoRA's adapters."""
    frozen = {id(each): each for each in policy.parameters() if not each.requires_grad}
    return copy.deepcopy(policy, frozen).requires_grad_(False)
