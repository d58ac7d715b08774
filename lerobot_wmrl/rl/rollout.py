"""Rollouts in preallocated tensors on the device.

T time, B environments, K action components, n steps that are acted by one decision.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium as gym
import torch
from torch import Tensor

from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.distributed import mean_over_processes, rank_and_size
from lerobot_wmrl.rl.observations import ObservationBuffer, as_bytes_see_it
from lerobot_wmrl.rl.protocol import Observation, Pipeline, Sample, StochasticPolicy

NOISE_SEED = 2**31
"""Added to a rollout's seed: the policy's noise must not be that with which the environment draws."""


class RolloutBuffer:
    """One iteration's steps, all (T, B); raw actions and log-probs (T, B, K), or (T, B, n, K) if the policy
    decides on n steps at once: then at the step of the decision, the only one of the n that is trained on.
    """

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
        self.age = empty(torch.long)
        """Steps since the decision that is acted on; 0 where one was made."""
        self.raw_action = self.log_prob = torch.empty(0)
        self.columns: dict[str, Tensor] = {}
        """What the updates need beside observation, raw_action and log_prob: (T, B, …) by name."""

    def write_decision(self, step: int, rows: Tensor, sample: Sample) -> None:
        """Keep what was sampled at `step` in the environments `rows`."""
        if not self.raw_action.numel():
            if sample.log_prob.dtype != torch.float32:
                raise ValueError(
                    f"policy: its log-probabilities are {sample.log_prob.dtype}, whose rounding would look "
                    "like a change of the policy; compute them in float32"
                )
            shape = (self.steps, self.num_envs, *sample.raw_action.shape[1:])
            self.raw_action = sample.raw_action.new_zeros(shape)
            self.log_prob = torch.zeros(shape, dtype=torch.float32, device=self.device)
        self.raw_action[step, rows] = sample.raw_action
        self.log_prob[step, rows] = sample.log_prob
        self.value[step, rows] = sample.value

    def write(self, step: int, age: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor) -> None:
        """Keep the outcome of `step`, of decisions made `age` steps before. All (B,)"""
        self.value[step].masked_fill_(age > 0, 0.0)
        self.age[step], self.reward[step] = age, reward
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
    def total_envs(self) -> int:
        """Environments of all processes."""
        return self.num_envs * rank_and_size()[1]

    @property
    def finished(self) -> Tensor:
        return self.terminated | self.truncated

    @property
    def decided(self) -> Tensor:
        """Where the policy made a decision. (T, B) bool"""
        return self.age == 0

    @property
    def first_episode(self) -> Tensor:
        """The steps of each environment's first episode, which began where its seed says. (T, B) bool"""
        ended = self.finished.long()
        return ended.cumsum(0) == ended

    def executed(self) -> Tensor | None:
        """Which of a decision's n steps were acted. → (T, B, n, 1) bool, None for n = 1"""
        if self.raw_action.ndim < 4:
            return None
        length = torch.ones_like(self.age)
        for step in reversed(range(self.steps - 1)):
            length[step] += torch.where(self.decided[step + 1], 0, length[step + 1])
        return torch.arange(self.raw_action.shape[2], device=self.device)[:, None] < length[..., None, None]

    def statistics(self) -> dict[str, float]:
        """Success and length of each environment's first episode; of later ones only short ones would end."""
        first = self.finished & self.first_episode
        steps = torch.arange(1, self.steps + 1, device=self.device)[:, None]
        episodes = first.sum().clamp_min(1)
        return {
            "success_rate": ((self.success & first).sum() / episodes).item(),
            "episode_length": ((steps * first).sum() / episodes).item(),
            "reward": self.reward.mean().item(),
        }


class Actor:
    """Asks the policy where a decision is due, and otherwise goes on with the last one.

    Ages of decisions are counted on the host too, and fetched only when an episode has ended.
    """

    def __init__(self, policy: StochasticPolicy, pipeline: Pipeline, buffer: RolloutBuffer) -> None:
        self.policy, self.pipeline, self.buffer = policy, pipeline, buffer
        self.here = torch.arange(buffer.num_envs, device=buffer.device)
        self.age = torch.zeros_like(self.here)
        self.known_age = [0] * buffer.num_envs
        self.plan = torch.empty(0, 1, 0)
        """The decisions that are acted on, (B, n, K)."""

    def act(self, step: int) -> Tensor:
        """The raw action of every environment at `step`. → (B, K)"""
        due, count = [row for row, age in enumerate(self.known_age) if not age], self.buffer.num_envs
        if len(due) == count:
            self._decide(step, self.here, self.buffer.observations.read_step(step))
        elif due:
            rows = torch.tensor(due)
            observed = self.buffer.observations.read(step * count + rows)
            self._decide(step, rows.to(self.here.device), observed)
        return self.plan[self.here, self.age]

    def advance(self, finished: Tensor, any_finished: bool) -> None:
        """A new decision is due after n steps, and where an episode has ended. (B,)"""
        length = self.plan.shape[1]
        self.age = torch.where(finished, 0, (self.age + 1) % length)
        if length > 1:
            following = [(age + 1) % length for age in self.known_age]
            self.known_age = self.age.tolist() if any_finished else following

    def _decide(self, step: int, rows: Tensor, observed: Observation) -> None:
        sample = self.policy.sample(self.pipeline.prepare(observed))
        self.buffer.write_decision(step, rows, sample)
        raw = sample.raw_action if sample.raw_action.ndim == 3 else sample.raw_action[:, None]
        if not self.plan.numel():
            self.plan = raw.new_zeros((self.buffer.num_envs, *raw.shape[1:]))
        self.plan[rows] = raw


@contextmanager
def noise_of(seed: int, device: torch.device | str) -> Iterator[None]:
    """Random numbers as `seed` has them, the generators as they were afterwards."""
    on_cuda = torch.device(device).type == "cuda"
    with torch.random.fork_rng([torch.cuda.current_device()] if on_cuda else []):
        torch.manual_seed(seed + NOISE_SEED)
        yield


def start_seeds(first: int, num_envs: int, group_size: int) -> int | list[int]:
    """What to reset with: the first seed of `num_envs`, or a drawn one for each `group_size` of them."""
    if group_size == 1:
        return first
    generator = torch.Generator().manual_seed(first)
    drawn = torch.randint(EVALUATION_SEED, (num_envs // group_size,), generator=generator)
    return drawn.repeat_interleave(group_size).tolist()


@torch.no_grad()
def collect(
    env: gym.vector.VectorEnv, policy: StochasticPolicy, pipeline: Pipeline, buffer: RolloutBuffer, seed: int,
    group_size: int = 1,
) -> dict[str, float]:  # fmt: skip
    """Fill `buffer` from fresh episodes; every decision's `next_value` too. → numbers to log

    Every `group_size` neighbouring environments begin alike. `seed` is the first of all processes'
    environments; starts and noise of this one's are drawn from its share.
    """
    own = rank_and_size()[0] * buffer.num_envs
    starts = start_seeds(seed, buffer.total_envs, group_size)
    reset = seed + own if isinstance(starts, int) else starts[own : own + buffer.num_envs]
    observation, _ = env.reset(seed=reset)
    actor, logged = Actor(policy, pipeline, buffer), dict[str, list[Tensor]]()
    with noise_of(seed + own, buffer.device):
        for step in range(buffer.steps):
            buffer.observations.write(step, observation)
            raw_action, age = actor.act(step), actor.age
            action = pipeline.to_action(raw_action).to(buffer.device)
            observation, reward, terminated, truncated, info = env.step(action)
            buffer.write(step, age, reward, terminated, truncated)
            actor.advance(terminated | truncated, any_finished="final_obs" in info)
            for name, part in info.get("reward_parts", {}).items():
                logged.setdefault(name, []).append(part.float().mean())
            if "final_obs" in info:
                final = pipeline.prepare(as_bytes_see_it(info["final_obs"]))
                buffer.write_end(step, info["final_info"]["is_success"], policy.value(final))
        last = policy.value(pipeline.prepare(as_bytes_see_it(observation)))
    buffer.fill_next_value(last)
    parts = {name: torch.stack(values).mean().item() for name, values in logged.items()}
    return mean_over_processes({**buffer.statistics(), **parts}, buffer.device)
