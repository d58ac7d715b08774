"""What reinforcement learning needs of a policy. B environments, K action components.

A policy may decide on n steps at once, which are then acted one after the other: all (B, K) of a decision
are (B, n, K) for it, and it is asked again after n steps, or when an episode has begun.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

from lerobot.configs import PreTrainedConfig
from lerobot.processor import DeviceProcessorStep
from torch import Tensor, nn

Observation = dict[str, Any]
"""Tensors by LeRobot's names, batch first, and `task`: a list of instructions."""


class Sample(Protocol):
    """Actions as they were sampled, before any clipping or unnormalisation."""

    @property
    def raw_action(self) -> Tensor:
        """(B, K)"""

    @property
    def log_prob(self) -> Tensor:
        """One a component, float32. (B, K)"""

    @property
    def value(self) -> Tensor:
        """(B,)"""


@runtime_checkable
class StochasticPolicy(Protocol):
    """A policy that can sample, and say how likely a sample is. Observations come from its preprocessor."""

    def sample(self, observation: Observation) -> Sample:
        """Draw actions from the very distribution that `evaluate` measures."""

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """→ log-probs (B, K), entropies (B,) of all that was decided, values (B,)"""

    def value(self, observation: Observation) -> Tensor:
        """→ (B,)"""

    def value_parameters(self) -> Iterable[nn.Parameter]:
        """Parameters that only the value depends on."""


@dataclass(frozen=True)
class Pipeline:
    """A policy's processors: `prepare` an environment's observation, turn raw actions into metres."""

    prepare: Callable[[Observation], Observation]
    to_action: Callable[[Tensor], Tensor]


def make_pipeline(config: PreTrainedConfig, preprocessor: Any, postprocessor: Any) -> Pipeline:
    """The processors as functions; observations the policy does not know are left out, and actions stay on
    the policy's device, where LeRobot's postprocessors would fetch them."""
    known = {*(config.input_features or {}), "task"}
    steps = [
        replace(step, device=config.device) if isinstance(step, DeviceProcessorStep) else step
        for step in postprocessor.steps
    ]
    staying = replace(postprocessor, steps=steps)

    def prepare(observation: Observation) -> Observation:
        return preprocessor({name: value for name, value in observation.items() if name in known})

    def to_action(raw_action: Tensor) -> Tensor:
        return staying(raw_action)

    return Pipeline(prepare, to_action)
