"""Policies with adapters (PEFT): what is trained is small, and saved without the network that it adapts."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig as AdapterSettings
from lerobot.policies.factory import get_policy_class
from peft import PeftConfig, PeftModel, set_peft_model_state_dict


def with_new_adapters(policy: Any, settings: AdapterSettings) -> Any:
    """What `--peft.…` asks for, as lerobot-train does it. ValueError if the policy has adapters already."""
    if isinstance(policy, PeftModel):
        raise ValueError("--peft: the policy has adapters already, which are trained further; leave it out")
    return policy.wrap_with_peft(peft_cli_overrides=asdict(settings))


def load_with_adapters(config: PreTrainedConfig, **options: Any) -> Any:
    """The policy that an adapter was trained on, with the adapter, ready to be trained further.

    `options` go to the policy's `from_pretrained`. ValueError if that policy is not there.
    """
    path = str(config.pretrained_path)
    adapter = PeftConfig.from_pretrained(path)
    base = adapter.base_model_name_or_path
    if not may_be_on_hub(base) and not Path(base).is_dir():
        raise ValueError(
            f"{path}: adapts the policy in {base}, which is not there; put it back, start this where its "
            "training was started, or write where it is now into adapter_config.json, base_model_name_or_path"
        )
    policy_class = get_policy_class(config.type)
    policy = policy_class.from_pretrained(
        base, config=config, revision=adapter.revision, strict=True, **options
    )
    return PeftModel.from_pretrained(policy, path, config=adapter, is_trainable=True)


def may_be_on_hub(name: str) -> bool:
    """Whether a name can be one of the hub's: `model` or `owner/model`. All others are paths."""
    return len(Path(name).parts) <= 2 and not name.startswith((".", "/"))


def unwrapped(policy: Any) -> Any:
    """The policy inside its adapters."""
    return policy.get_base_model() if isinstance(policy, PeftModel) else policy


def load_trained_weights(policy: Any, weights: dict[str, Any]) -> None:
    """What a checkpoint holds: all weights, or those of the adapters. RuntimeError if they do not fit."""
    if not isinstance(policy, PeftModel):
        policy.load_state_dict(weights)
        return
    unexpected = set_peft_model_state_dict(policy, weights).unexpected_keys
    if unexpected:
        raise RuntimeError(f"the adapters do not fit the policy: {unexpected[0]} is unknown")
