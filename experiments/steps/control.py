"""Do the algorithms solve what is known to be solvable? Gymnasium's control tasks, no world model.

    python -m experiments.steps.control --output=outputs/control.json
    python -m experiments.steps.control --output=outputs/short.json --trainings cartpole-ppo --seeds 0

The trainer, rollouts and algorithms of lerobot-wmrl-train, with small networks on the tasks' observations.
Every training is measured on 100 episodes with evaluation seeds, without exploration, against the score at
which the task counts as solved, and timed in seconds of one thread.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Normal

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.tensor_env import Outcome, TensorEnv
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig, PPOConfig
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.trainer import Schedule, make_algorithm, train

EPISODES: Final = 100
STATE: Final = "observation.state"
FREE: Final[dict[str, Any]] = {"reference_coefficient": 0.0, "max_reference_kl": 1e9}
"""There is no reference policy to stay near."""

VALUE: Final[dict[str, Any]] = {"value_lr": 3e-3, "value_iterations": 0}


class Training(NamedTuple):
    """A task, when it is solved, and how it is learnt."""

    task: str
    solved: float
    config: PolicyGradientConfig
    num_envs: int
    iterations: int


CARTPOLE: Final[dict[str, Any]] = {
    **FREE,
    "policy_lr": 2e-3,
    "minibatch_size": 512,
    "epochs": 6,
    "target_kl": 0.03,
}
PENDULUM: Final[dict[str, Any]] = {
    **FREE,
    "policy_lr": 1e-3,
    "minibatch_size": 400,
    "epochs": 8,
    "gamma": 0.95,
    "target_kl": 0.05,
}

TRAININGS: Final = {
    "cartpole-ppo": Training(
        "CartPole-v1", 475, PPOConfig(**CARTPOLE, **VALUE, gamma=0.99, value_normalisation=True), 8, 20
    ),
    "cartpole-grpo": Training(
        "CartPole-v1", 475, GRPOConfig(**CARTPOLE, group_size=8, least_group_std=1.0), 32, 25
    ),
    "pendulum-ppo": Training(
        "Pendulum-v1", -200, PPOConfig(**PENDULUM, **VALUE, value_normalisation=True), 16, 20
    ),
    "pendulum-ppo-raw-values": Training("Pendulum-v1", -200, PPOConfig(**PENDULUM, **VALUE), 16, 20),
}
"""CartPole-v1 is solved at 475 by gymnasium's own threshold; Pendulum-v1 has none, good policies get −200."""


class ControlEnv(TensorEnv):
    """Gymnasium's environments behind the tensor interface of the world model's."""

    def __init__(self, task: str, num_envs: int) -> None:
        self.envs = gym.make_vec(
            task,
            num_envs,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        )
        self.num_envs, self.single_action_space = num_envs, self.envs.single_action_space
        self.max_episode_steps, self.device = gym.spec(task).max_episode_steps, torch.device("cpu")
        space = self.single_action_space
        self.discrete = isinstance(space, gym.spaces.Discrete)
        self.action_low, self.action_high = (
            torch.as_tensor(end).float()
            for end in (([0], [space.n - 1]) if self.discrete else (space.low, space.high))
        )

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        self.elapsed = torch.zeros(self.num_envs, dtype=torch.long)
        return self._observe(self.envs.reset(seed=seed)[0]), {}

    def _advance(self, actions: Tensor) -> Outcome:
        """Take a step; the environments then begin anew by themselves."""
        chosen = actions[:, 0].long().numpy() if self.discrete else actions.numpy()
        self.seen, reward, *ends, info = self.envs.step(chosen)
        self.elapsed = self.elapsed + 1
        last = self.seen.copy()
        for row in np.flatnonzero(ends[0] | ends[1]):
            last[row] = info["final_obs"][row]
        terminated, truncated = (torch.from_numpy(end) for end in ends)
        return Outcome(
            self._observe(last),
            torch.from_numpy(reward).float(),
            terminated,
            truncated,
            truncated,
            self.elapsed,
        )

    def _restart(self, ended: Tensor, outcome: Outcome) -> Observation:
        self.elapsed = self.elapsed.masked_fill(ended, 0)
        return self._observe(self.seen)

    def close_extras(self, **kwargs: Any) -> None:
        self.envs.close()

    def _observe(self, observation: np.ndarray) -> Observation:
        return {STATE: torch.from_numpy(observation).float()}


class Sample(NamedTuple):
    """Actions and log-probs (B, K), values (B,)."""

    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class ControlPolicy(nn.Module):
    """Two small networks. Discrete actions are sampled as integers (B, 1), continuous ones around a mean."""

    def __init__(self, env: ControlEnv) -> None:
        super().__init__()
        space = env.single_action_space
        self.config, self.discrete = SimpleNamespace(type="control"), env.discrete
        self.scale = 1.0 if self.discrete else float(space.high[0])
        inputs = env.envs.single_observation_space.shape[0]
        self.actor = network(inputs, int(space.n) if self.discrete else space.shape[0], 0.01)
        self.critic = network(inputs, 1, 1.0)
        self.log_std = nn.Parameter(torch.zeros(1), requires_grad=not self.discrete)

    def _distribution(self, observation: Observation) -> Distribution:
        decided = self.actor(observation[STATE])
        if self.discrete:
            return Categorical(logits=decided[:, None])
        return Normal(decided, self.log_std.exp())

    def best(self, observation: Observation) -> Tensor:
        """Return the action without exploration. → (B, K)"""
        decided = self.actor(observation[STATE])
        return decided.argmax(dim=1, keepdim=True) if self.discrete else decided

    def sample(self, observation: Observation) -> Sample:
        distribution = self._distribution(observation)
        raw_action = distribution.sample()
        return Sample(raw_action, distribution.log_prob(raw_action), self.value(observation))

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        distribution = self._distribution(observation)
        log_prob, entropy = distribution.log_prob(raw_action), distribution.entropy().sum(dim=1)
        return log_prob, entropy, self.value(observation)

    def value(self, observation: Observation) -> Tensor:
        return self.critic(observation[STATE]).squeeze(1)

    def value_parameters(self) -> Iterator[nn.Parameter]:
        return self.critic.parameters()

    def to_action(self, raw_action: Tensor) -> Tensor:
        """Return actions in the task's units."""
        return raw_action if self.discrete else raw_action * self.scale


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network with two hidden layers; the last layer's weights are scaled by `gain`."""
    first, second, last = nn.Linear(inputs, 64), nn.Linear(64, 64), nn.Linear(64, outputs)
    for layer in (first, second, last):
        nn.init.orthogonal_(layer.weight, gain if layer is last else 2**0.5)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)


@torch.no_grad()
def score(task: str, policy: ControlPolicy) -> float:
    """Return the mean return of evaluation episodes."""
    env = ControlEnv(task, EPISODES)
    observation, _ = env.reset(seed=EVALUATION_SEED)
    running, returns = torch.ones(EPISODES, dtype=torch.bool), torch.zeros(EPISODES)
    while running.any():
        observation, reward, terminated, truncated, _ = env.step(policy.to_action(policy.best(observation)))
        returns += reward * running
        running &= ~(terminated | truncated)
    env.close()
    return returns.mean().item()


def measure(training: Training, iterations: int, seed: int) -> dict[str, float]:
    """Train once, by the trainer of lerobot-wmrl-train. → score, environment steps, seconds"""
    torch.manual_seed(seed)
    env = ControlEnv(training.task, training.num_envs)
    policy = ControlPolicy(env)
    pipeline = Pipeline(lambda observation: observation, policy.to_action)
    buffer = RolloutBuffer(env.max_episode_steps, training.num_envs, "cpu")
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        algorithm = make_algorithm(policy, training.config, Path(folder))
        train(
            env,
            algorithm,
            pipeline,
            buffer,
            Schedule(iterations, iterations, 1000 * seed),
            Path(folder),
            lambda path: path.mkdir(parents=True),
        )
    seconds = time.process_time() - began
    env.close()
    return {
        "score": round(score(training.task, policy), 1),
        "steps": iterations * buffer.steps * buffer.num_envs,
        "seconds": round(seconds, 1),
    }


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trainings", nargs="+", choices=TRAININGS, default=list(TRAININGS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, help="by default as many as each training needs")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main() -> None:
    """Train everything, print it, write it."""
    given = make_parser().parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for name in given.trainings:
        training = TRAININGS[name]
        runs = [measure(training, given.iterations or training.iterations, seed) for seed in given.seeds]
        results[name] = {"task": training.task, "solved": training.solved, "seeds": runs}
        print(json.dumps({name: results[name]}))
    write_json(given.output, results)


if __name__ == "__main__":
    main()
