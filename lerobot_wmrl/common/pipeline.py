"""A policy's processors, as functions of tensors that stay on its device."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.processor import DeviceProcessorStep
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
    """

    prepare: Callable[[Observation], Observation]
    to_action: Callable[[Tensor], Tensor]
    store: Callable[[Observation], Observation] = unchanged
    shown: Callable[[Observation], Observation] = unchanged


def make_pipeline(
    config: PreTrainedConfig, preprocessor: Any, postprocessor: Any,
    shown: Callable[[Observation], Observation] = unchanged,
) -> Pipeline:  # fmt: skip
    """Wrap a policy's processors. Observations that the policy has no input for are left out. Actions stay on
    the policy's device, where LeRobot's postprocessors would move them to the CPU."""
    known = {*(config.input_features or {}), INSTRUCTIONS, ACTION, ACTION_IS_PAD}
    steps = [
        replace(step, device=config.device) if isinstance(step, DeviceProcessorStep) else step
        for step in postprocessor.steps
    ]
    on_device = replace(postprocessor, steps=steps)

    def prepare(observation: Observation) -> Observation:
        return preprocessor(shown({name: value for name, value in observation.items() if name in known}))

    def to_action(raw_action: Tensor) -> Tensor:
        return on_device(raw_action)

    return Pipeline(prepare, to_action, shown=shown)
