"""Observations kept between a rollout and the updates. T time, B environments."""

import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor

from lerobot_wmrl.rl.protocol import Observation

TASK = "task"


class ObservationBuffer:
    """Observations of T x B steps. Images are kept as bytes, which is also how a policy meets them in
    reality; it samples from what is kept, so that is bit by bit what it is trained on."""

    def __init__(self, steps: int, num_envs: int) -> None:
        self.steps, self.num_envs = steps, num_envs
        self.tensors: dict[str, Tensor] = {}
        self.instructions: dict[str, int] = {}

    def write(self, step: int, observation: Observation) -> None:
        """Keep the observations (B, …) of `step`."""
        for name, value in encode(observation, self.instructions).items():
            if name not in self.tensors:
                self.tensors[name] = value.new_empty((self.steps, self.num_envs, *value.shape[1:]))
            self.tensors[name][step] = value

    def read_step(self, step: int) -> Observation:
        """The observations (B, …) of `step`, where they are."""
        return decode({name: value[step] for name, value in self.tensors.items()}, self.instructions)

    def read(self, rows: Tensor) -> Observation:
        """Observations of flat rows step * B + environment. `rows` lies in the CPU's memory, as instructions
        do: so that none is fetched from the device."""
        moved = {device: rows.to(device) for device in {value.device for value in self.tensors.values()}}
        taken = {name: value.flatten(0, 1)[moved[value.device]] for name, value in self.tensors.items()}
        return decode(taken, self.instructions)


def encode(observation: Observation, instructions: dict[str, int]) -> dict[str, Tensor]:
    """Images as bytes, instructions as indices into `instructions`, which grows; these on the CPU."""
    encoded = {
        name: (value * 255).round().byte() if name.startswith(OBS_IMAGES) else value
        for name, value in observation.items()
        if isinstance(value, Tensor)
    }
    indices = [instructions.setdefault(text, len(instructions)) for text in observation.get(TASK, [])]
    if indices:
        encoded[TASK] = torch.tensor(indices)
    return encoded


def decode(encoded: dict[str, Tensor], instructions: dict[str, int]) -> Observation:
    """The inverse of `encode`."""
    texts = list(instructions)
    observation: Observation = {
        name: value.float() / 255 if name.startswith(OBS_IMAGES) else value for name, value in encoded.items()
    }
    if TASK in encoded:
        observation[TASK] = [texts[index] for index in encoded[TASK].tolist()]
    return observation


def as_bytes_see_it(observation: Observation) -> Observation:
    """Images rounded to bytes and back."""
    instructions: dict[str, int] = {}
    return decode(encode(observation, instructions), instructions)
