"""Rollouts: collected from an environment into preallocated tensors on the device.

T time, B environments, K action components, n steps of one decision (an action chunk).
"""

import torch
from torch import Tensor
from tqdm import tqdm

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.distributed import hidden_progress, mean_over_processes
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.envs.tensor_env import NanActionError, TensorEnv
from lerobot_wmrl.rl.observations import ObservationBuffer, as_read_back, at_rows
from lerobot_wmrl.rl.protocol import ActionSample, StochasticPolicy
from lerobot_wmrl.rl.seeds import seeded_noise, start_seeds


class RolloutBuffer:
    """The steps of one rollout, preallocated.

    All fields are (T, B); `raw_action` and `log_prob` are (T, B, K), or (T, B, n, K) for action chunks. A
    chunk is stored in the row of its first step. Only such rows, where the policy decided, are trained on.
    `age` counts the steps since the policy decided on the action; it is 0 where it decides.

    Args:
        steps: T.
        num_envs: B.
        device: device of the tensors.
        longest: steps of the longest possible episode; T by default.
    """

    def __init__(
        self, steps: int, num_envs: int, device: torch.device | str, longest: int | None = None
    ) -> None:
        def empty(dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros((steps, num_envs), dtype=dtype, device=device)

        self.steps, self.num_envs, self.device = steps, num_envs, device
        self.longest = longest or steps
        self.observations = ObservationBuffer(steps, num_envs)
        self.reward, self.value, self.next_value = empty(), empty(), empty()
        self.final_value = torch.full((steps, num_envs), torch.nan, device=device)
        self.terminated, self.truncated = empty(torch.bool), empty(torch.bool)
        self.success, self.age = empty(torch.bool), empty(torch.long)
        self.raw_action = self.log_prob = torch.empty(0)
        self.columns: dict[str, Tensor] = {}
        """Inputs of the loss that an algorithm adds, such as advantages: (T, B, …) by name."""

    def write_decision(self, step: int, rows: Tensor, sample: ActionSample) -> None:
        """Store the decisions that were sampled at `step` for the environments `rows` (N,)."""
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
        """Store the outcome of `step`, whose actions were decided `age` steps before. All (B,)"""
        self.value[step].masked_fill_(age > 0, 0.0)  # an earlier rollout may have decided there
        self.age[step], self.reward[step] = age, reward
        self.success[step], self.final_value[step] = False, torch.nan
        self.terminated[step], self.truncated[step] = terminated, truncated

    def write_end(self, step: int, rows: Tensor, success: Tensor, final_value: Tensor) -> None:
        """Store success and value of the final observation where an episode ended at `step`.

        Args:
            step: the step.
            rows: environments in which one ended. (E,)
            success: of all environments. (B,)
            final_value: of `rows`. (E,)
        """
        self.success[step, rows] = success[rows]
        self.final_value[step, rows] = final_value

    def fill_next_value(self, last_value: Tensor) -> None:
        """Set V(o_{t+1}): the next row's value, or the final observation's where an episode has ended."""
        following = torch.cat([self.value[1:], last_value[None]])  # (T, B)
        self.next_value = torch.where(self.finished, self.final_value, following)
        if not bool(self.value.isfinite().all() & self.next_value.isfinite().all()):
            raise TrainingStopped(
                "rollout: the policy's value is not finite, because its observation or its weights are not; "
                "the last checkpoint is kept: lower `algorithm.policy_lr`, or `algorithm.value_lr` of PPO"
            )

    @property
    def finished(self) -> Tensor:
        """Steps at which an episode ended. (T, B) bool"""
        return self.terminated | self.truncated

    @property
    def decided(self) -> Tensor:
        """Steps at which the policy made a decision. (T, B) bool"""
        return self.age == 0

    @property
    def first_episode(self) -> Tensor:
        """Steps of each environment's first episode, the one that its seed determines. (T, B) bool"""
        ended = self.finished.long()
        return ended.cumsum(0) == ended

    def executed(self) -> Tensor:
        """Return which actions of each chunk were executed. (T, B, n, 1) bool; without chunks (T, B, 1)"""
        if self.raw_action.ndim < 4:
            return torch.ones_like(self.decided)[..., None]
        length = torch.ones_like(self.age)  # (T, B), steps until the next decision or the rollout's end
        for step in reversed(range(self.steps - 1)):
            length[step] += torch.where(self.decided[step + 1], 0, length[step + 1])
        return torch.arange(self.raw_action.shape[2], device=self.device)[:, None] < length[..., None, None]

    def statistics(self) -> dict[str, float]:
        """Return the mean reward of all steps, and success rate and length of the episodes that had the time
        to end within the rollout, however long. Of later ones only short ones would count. Every environment
        has the same weight, however many of its episodes there are."""
        step = torch.arange(self.steps, device=self.device)[:, None]
        last_begin = torch.where(self.finished, step + 1, 0).roll(1, 0)
        last_begin[0] = 0
        begin = last_begin.cummax(0).values  # (T, B), of the episode that a step belongs to
        counted = self.finished & (begin + self.longest <= self.steps)
        episodes = counted.sum(0)  # (B,)

        def mean(values: Tensor) -> float:
            each = (values * counted).sum(0) / episodes.clamp_min(1)
            return (each.sum() / (episodes > 0).sum().clamp_min(1)).item()

        return {
            "success_rate": mean(self.success),
            "episode_length": mean(step + 1 - begin),
            "reward": self.reward.mean().item(),
        }


class Actor:
    """Executes action chunks: asks the policy where a decision is due, elsewhere takes a chunk's next action.

    A copy of `age` on the host says where a decision is due, so that the device is read only when an episode
    ends. Without chunks n = 1.
    """

    def __init__(self, policy: StochasticPolicy, pipeline: Pipeline, buffer: RolloutBuffer) -> None:
        self.policy, self.pipeline, self.buffer = policy, pipeline, buffer
        self.all_rows = torch.arange(buffer.num_envs, device=buffer.device)
        self.age = torch.zeros_like(self.all_rows)
        self.host_age = [0] * buffer.num_envs
        self.chunk = torch.empty(0, 1, 0)
        """The action chunks that are executed, (B, n, K)."""

    def act(self, step: int) -> Tensor:
        """Return the raw action of every environment at `step`. (B, K)"""
        due, count = [row for row, age in enumerate(self.host_age) if not age], self.buffer.num_envs
        if len(due) == count:
            self._decide(step, self.all_rows, self.buffer.observations.read_step(step))
        elif due:
            rows = torch.tensor(due)
            observed = self.buffer.observations.read(step * count + rows)
            self._decide(step, rows.to(self.all_rows.device), observed)
        return self.chunk[self.all_rows, self.age]

    def advance(self, finished: Tensor, any_finished: bool) -> None:
        """Count one step. A decision is due after n steps and where an episode has `finished`, (B,) bool.
        `any_finished` says whether one has, without reading the device."""
        length = self.chunk.shape[1]
        self.age = torch.where(finished, 0, (self.age + 1) % length)
        if length > 1:
            following = [(age + 1) % length for age in self.host_age]
            self.host_age = self.age.tolist() if any_finished else following

    def _decide(self, step: int, rows: Tensor, observed: Observation) -> None:
        sample = self.policy.sample(self.pipeline.prepare(observed))
        self.buffer.write_decision(step, rows, sample)
        raw = sample.raw_action if sample.raw_action.ndim == 3 else sample.raw_action[:, None]  # (B, n, K)
        if not self.chunk.numel():
            self.chunk = raw.new_zeros((self.buffer.num_envs, *raw.shape[1:]))
        self.chunk[rows] = raw


@torch.no_grad()
def collect(
    env: TensorEnv,
    policy: StochasticPolicy,
    pipeline: Pipeline,
    buffer: RolloutBuffer,
    seed: int,
    group_size: int = 1,
) -> dict[str, float]:
    """Fill `buffer` with T steps of new episodes, and return metrics, averaged over all processes.

    Args:
        env: B environments.
        policy: draws the actions.
        pipeline: the policy's processors.
        buffer: receives the rollout; what it holds is overwritten.
        seed: first of this process's B environment seeds, and seed of the policy's noise.
        group_size: neighbouring environments that start from the same state.
    """
    observation, _ = env.reset(seed=start_seeds(seed, buffer.num_envs, group_size))
    actor, logged = Actor(policy, pipeline, buffer), dict[str, list[Tensor]]()
    with seeded_noise(seed, buffer.device):
        for step in tqdm(range(buffer.steps), "rollout", leave=False, unit="step", disable=hidden_progress()):
            buffer.observations.write(step, pipeline.store(observation))
            raw_action, age = actor.act(step), actor.age  # (B, K), (B,)
            action = pipeline.to_action(raw_action).to(buffer.device)
            try:
                observation, reward, terminated, truncated, info = env.step(action)
            except NanActionError as error:
                raise TrainingStopped(
                    f"rollout: {error}. The last checkpoint is kept: lower `algorithm.policy_lr`"
                ) from error
            buffer.write(step, age, reward, terminated, truncated)
            actor.advance(terminated | truncated, any_finished="final_obs" in info)
            for name, part in info.get("reward_parts", {}).items():
                logged.setdefault(name, []).append(part.float().mean())
            if "final_obs" in info:
                rows = (terminated | truncated).nonzero()[:, 0]
                final = pipeline.prepare(as_read_back(pipeline.store(at_rows(info["final_obs"], rows))))
                buffer.write_end(step, rows, info["final_info"]["is_success"], policy.value(final))
        last_value = policy.value(pipeline.prepare(as_read_back(pipeline.store(observation))))
    buffer.fill_next_value(last_value)
    parts = {name: torch.stack(values).mean().item() for name, values in logged.items()}
    return mean_over_processes({**buffer.statistics(), **parts}, buffer.device)
