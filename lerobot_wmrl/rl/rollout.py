"""Rollouts in preallocated tensors on the device. T time, B environments, K action components."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor

from lerobot_wmrl.rl.protocol import Observation, Pipeline, Sample, StochasticPolicy

TASK = "task"
Minibatch = dict[str, Any]


class ObservationBuffer:
    """Observations of T x B steps. Images are kept as bytes, which is also how a policy meets them in
    reality; it samples from what is kept, so that is bit by bit what it is trained on."""

    def __init__(self, steps: int, num_envs: int) -> None:
        self.steps, self.num_envs = steps, num_envs
        self.tensors: dict[str, Tensor] = {}
        self.instructions: dict[str, int] = {}

    def write(self, step: int, observation: Observation) -> None:
        """Keep the observations (B, …) that the actions of `step` answer."""
        for name, tensor in encode(observation, self.instructions).items():
            if name not in self.tensors:
                self.tensors[name] = tensor.new_empty((self.steps, self.num_envs, *tensor.shape[1:]))
            self.tensors[name][step] = tensor

    def read(self, rows: Tensor) -> Observation:
        """Observations of flat rows step * B + environment."""
        return decode(
            {name: tensor.flatten(0, 1)[rows] for name, tensor in self.tensors.items()}, self.instructions
        )


def encode(observation: Observation, instructions: dict[str, int]) -> dict[str, Tensor]:
    """Images as bytes, instructions as indices into `instructions`, which grows."""
    encoded = {
        name: (value * 255).round().byte() if name.startswith(OBS_IMAGES) else value
        for name, value in observation.items()
        if isinstance(value, Tensor)
    }
    indices = [instructions.setdefault(text, len(instructions)) for text in observation.get(TASK, [])]
    if indices:
        device = next(iter(encoded.values())).device
        encoded[TASK] = torch.tensor(indices, device=device)
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


class RolloutBuffer:
    """One iteration's steps, all (T, B), actions and log-probs (T, B, K)."""

    def __init__(self, steps: int, num_envs: int, device: torch.device | str) -> None:
        def empty(dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros((steps, num_envs), dtype=dtype, device=device)

        self.steps, self.num_envs, self.device = steps, num_envs, device
        self.observations = ObservationBuffer(steps, num_envs)
        self.reward, self.value, self.next_value = empty(), empty(), empty()
        self.final_value = torch.full((steps, num_envs), torch.nan, device=device)
        self.terminated, self.truncated, self.success = (
            empty(torch.bool),
            empty(torch.bool),
            empty(torch.bool),
        )
        self.raw_action = self.log_prob = torch.empty(0)
        self.columns: dict[str, Tensor] = {}
        """What the updates need beside observation, raw_action and log_prob: (T, B, …) by name."""

    def write(self, step: int, sample: Sample, reward: Tensor, terminated: Tensor, truncated: Tensor) -> None:
        """Keep what was sampled at `step`, and its outcome."""
        if not self.raw_action.numel():
            shape = (self.steps, *sample.raw_action.shape)
            self.raw_action = sample.raw_action.new_empty(shape)
            self.log_prob = torch.empty(shape, dtype=torch.float32, device=self.device)
        self.raw_action[step], self.log_prob[step] = sample.raw_action, sample.log_prob
        self.value[step], self.reward[step] = sample.value, reward
        self.success[step], self.final_value[step] = False, torch.nan
        self.terminated[step], self.truncated[step] = terminated, truncated

    def write_end(self, step: int, success: Tensor, final_value: Tensor) -> None:
        """Keep an ended episode's outcome and the value of its final observation. (B,), (B,)"""
        self.success[step] = success & self.finished[step]
        self.final_value[step] = final_value

    def fill_next_value(self, last_value: Tensor) -> None:
        """V(o_{t+1}): the next row's, or the final observation's where the next row is another episode."""
        following = torch.cat([self.value[1:], last_value[None]])
        self.next_value = torch.where(self.finished, self.final_value, following)
        if not bool(self.value.isfinite().all()):
            raise ValueError(
                "rollout: the policy's value is not finite, so neither is what it saw or became; the last "
                "checkpoint is kept: lower --algorithm.value_lr or --algorithm.policy_lr"
            )
        if not bool(self.next_value.isfinite().all()):
            raise ValueError(
                "environment: an episode ended without `final_obs` in info, or the value is not finite"
            )

    @property
    def finished(self) -> Tensor:
        return self.terminated | self.truncated

    def statistics(self) -> dict[str, float]:
        """Success and length of each environment's first episode; of later ones only short ones would end."""
        first = self.finished.cumsum(0).cumsum(0) == 1
        steps = torch.arange(1, self.steps + 1, device=self.device)[:, None]
        episodes = first.sum().clamp_min(1)
        return {
            "success_rate": ((self.success & first).sum() / episodes).item(),
            "episode_length": ((steps * first).sum() / episodes).item(),
            "reward": self.reward.mean().item(),
            "value": self.value.mean().item(),
        }

    def minibatches(self, size: int, epochs: int, pipeline: Pipeline) -> Iterator[Minibatch]:
        """Every step once an epoch, in random order, `size` steps at a time."""
        for _ in range(epochs):
            for rows in torch.randperm(self.steps * self.num_envs).split(size):
                yield self.minibatch(rows.to(self.device), pipeline)

    def minibatch(self, rows: Tensor, pipeline: Pipeline) -> Minibatch:
        """The steps of flat rows step * B + environment."""
        stored = {"raw_action": self.raw_action, "log_prob": self.log_prob, **self.columns}
        taken = {name: tensor.flatten(0, 1)[rows] for name, tensor in stored.items()}
        return {"observation": pipeline.prepare(self.observations.read(rows)), **taken}


@torch.no_grad()
def collect(
    env: gym.vector.VectorEnv, policy: StochasticPolicy, pipeline: Pipeline, buffer: RolloutBuffer, seed: int
) -> dict[str, float]:
    """Fill `buffer` from fresh episodes; every step's `next_value` too. → numbers to log"""
    observation, _ = env.reset(seed=seed)
    here = torch.arange(buffer.num_envs, device=buffer.device)
    logged: dict[str, list[Tensor]] = {}
    for step in range(buffer.steps):
        buffer.observations.write(step, observation)
        prepared = pipeline.prepare(buffer.observations.read(step * buffer.num_envs + here))
        sample = policy.sample(prepared)
        action = pipeline.to_action(sample.raw_action).to(buffer.device)
        observation, reward, terminated, truncated, info = env.step(action)
        buffer.write(step, sample, reward, terminated, truncated)
        for name, part in info.get("reward_parts", {}).items():
            logged.setdefault(name, []).append(part.float().mean())
        if "final_obs" in info:
            final = pipeline.prepare(as_bytes_see_it(info["final_obs"]))
            buffer.write_end(step, info["final_info"]["is_success"], policy.value(final))
    last = policy.value(pipeline.prepare(as_bytes_see_it(observation)))
    buffer.fill_next_value(last)
    parts = {name: torch.stack(values).mean().item() for name, values in logged.items()}
    return {**buffer.statistics(), **parts}
