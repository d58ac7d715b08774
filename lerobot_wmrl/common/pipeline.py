"""A policy's processors, as functions of tensors that stay on its device."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.processor import DeviceProcessorStep, TransitionKey, UnnormalizerProcessorStep, create_transition
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_wmrl.common.constants import INSTRUCTIONS, Observation

ACTION_IS_PAD = f"{ACTION}_is_pad"
"""Marks the actions of a chunk beyond the end of the episode, in LeRobot's batches. (B, n) bool"""


def unchanged(observation: Observation) -> Observation:
    return observation


@dataclass(frozen=True)
class Pipeline:
    """A policy's processors as functions.

    Args:
        prepare: turns a stored observation into the policy's.
        to_action: turns raw actions into the environment's.
        store: turns the environment's observation into the stored one.
        shown: turns stored frames into those of the size that the policy sees, the first step of `prepare`.
        action_unit: what 1 in a normalised action is in the environment's units, (A,); None where actions are
            not normalised.
    """

    prepare: Callable[[Observation], Observation]
    to_action: Callable[[Tensor], Tensor]
    store: Callable[[Observation], Observation] = unchanged
    shown: Callable[[Observation], Observation] = unchanged
    action_unit: Tensor | None = None


def make_pipeline(
    config: PreTrainedConfig,
    preprocessor: Any,
    postprocessor: Any,
    shown: Callable[[Observation], Observation] = unchanged,
) -> Pipeline:
    """Wrap a policy's processors. What the policy has no input for is not stored. Actions stay on the
    policy's device, where LeRobot's postprocessors would move them to the CPU."""
    known = {*(config.input_features or {}), INSTRUCTIONS, ACTION, ACTION_IS_PAD}
    steps = [
        replace(step, device=config.device) if isinstance(step, DeviceProcessorStep) else step
        for step in postprocessor.steps
    ]
    on_device = replace(postprocessor, steps=steps)

    def store(observation: Observation) -> Observation:
        return {name: value for name, value in observation.items() if name in known}

    def prepare(observation: Observation) -> Observation:
        return preprocessor(shown(store(observation)))

    def to_action(raw_action: Tensor) -> Tensor:
        return on_device(raw_action)

    return Pipeline(prepare, to_action, store, shown, action_unit=action_unit(config, postprocessor))


def action_unit(config: PreTrainedConfig, postprocessor: Any) -> Tensor | None:
    """Return what 1 in a policy's normalised actions is in the environment's units, (A,), if they are."""
    for step in postprocessor.steps:
        if isinstance(step, UnnormalizerProcessorStep) and ACTION in (step.stats or {}):
            mode = step.norm_map.get(FeatureType.ACTION, NormalizationMode.IDENTITY)
            if mode is not NormalizationMode.IDENTITY:
                size = config.output_features[ACTION].shape
                none, one = (
                    step(create_transition(action=torch.full((1, *size), each)))[TransitionKey.ACTION]
                    for each in (0.0, 1.0)
                )
                return (one - none)[0].abs()
    return None
