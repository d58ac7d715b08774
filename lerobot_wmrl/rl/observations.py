"""Storage of a rollout's observations. T time, B environments."""

from collections.abc import Sequence

import torch
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

from lerobot_wmrl.common.constants import INSTRUCTIONS, Observation
from lerobot_wmrl.common.images import from_bytes, to_bytes


class ObservationBuffer:
    """Observations of T × B steps. Images are stored as bytes and instructions as indices.

    During the rollout the policy also acts on observations read from here, so that updates see exactly what
    it has seen, rounding to bytes included.
    """

    def __init__(self, steps: int, num_envs: int) -> None:
        self.steps, self.num_envs = steps, num_envs
        self.tensors: dict[str, Tensor] = {}  # (T, B, …) by name
        self.instructions: dict[str, int] = {}

    def write(self, step: int, observation: Observation) -> None:
        """Store the observations (B, …) of `step`."""
        encoded = {
            name: to_bytes(value) if name.startswith(OBS_IMAGE) else value
            for name, value in observation.items()
            if isinstance(value, Tensor)
        }
        if texts := observation.get(INSTRUCTIONS):
            indices = [self.instructions.setdefault(text, len(self.instructions)) for text in texts]
            encoded[INSTRUCTIONS] = torch.tensor(indices)  # on the CPU, where the texts are
        for name, value in encoded.items():
            if name not in self.tensors:
                self.tensors[name] = value.new_empty((self.steps, self.num_envs, *value.shape[1:]))
            self.tensors[name][step] = value

    def read_step(self, step: int) -> Observation:
        """Return the observations (B, …) of `step`."""
        return self._decoded({name: value[step] for name, value in self.tensors.items()})

    def read(self, rows: Tensor) -> Observation:
        """Return the observations of flat rows t · B + b. `rows` (N,) is on the CPU, as the instructions are:
        no device has to be waited for."""
        return self._decoded(self.read_stored(rows))

    def read_stored(self, rows: Tensor) -> dict[str, Tensor]:
        """Return the observations of `rows`, as in `read`, as they are stored."""
        rows_on = {device: rows.to(device) for device in {value.device for value in self.tensors.values()}}
        return {name: value.flatten(0, 1)[rows_on[value.device]] for name, value in self.tensors.items()}

    def _decoded(self, stored: dict[str, Tensor]) -> Observation:
        return as_policy_input(stored, list(self.instructions))


def as_policy_input(stored: dict[str, Tensor], instructions: Sequence[str]) -> Observation:
    """Return stored observations as the policy sees them: images in [0, 1], instructions as texts."""
    return {
        name: from_bytes(value)
        if name.startswith(OBS_IMAGE)
        else [instructions[index] for index in value.tolist()]
        if name == INSTRUCTIONS
        else value
        for name, value in stored.items()
    }


def at_rows(observation: Observation, rows: Tensor) -> Observation:
    """Return the observations of the environments `rows`. (B, …), (E,) → (E, …)"""
    return {
        name: value[rows.to(value.device)]
        if isinstance(value, Tensor)
        else [value[row] for row in rows.tolist()]
        for name, value in observation.items()
    }


def as_read_back(observation: Observation) -> Observation:
    """Return the observation with images rounded to bytes, as an ObservationBuffer would return it."""
    return {
        name: from_bytes(to_bytes(value)) if name.startswith(OBS_IMAGE) else value
        for name, value in observation.items()
    }
