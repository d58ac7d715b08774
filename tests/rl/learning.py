"""One iteration of an algorithm, and what it means that it learns."""

import gymnasium as gym
from lerobot.rl.algorithms.configs import TrainingStats

from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect


def update(algorithm: PolicyGradient, buffer: RolloutBuffer, pipeline: Pipeline) -> TrainingStats:
    """Update on a filled buffer, as the trainer does; all metrics are in `extra`."""
    minibatches, metrics = algorithm.make_minibatches(buffer, pipeline)
    stats = algorithm.update(iter(minibatches))
    stats.extra = {**metrics, **stats.extra}
    return stats


def assert_it_learns(
    algorithm: PolicyGradient,
    env: gym.vector.VectorEnv,
    buffer: RolloutBuffer,
    pipeline: Pipeline,
    iterations: int,
) -> None:
    """Its policy fails at first and mostly succeeds in the end."""
    rates = []
    for iteration in range(iterations):
        first = buffer.num_envs * iteration
        found = collect(env, algorithm.policy, pipeline, buffer, first, algorithm.group_size)
        rates.append(found["success_rate"])
        update(algorithm, buffer, pipeline)
    assert max(rates[:2]) < 0.3
    assert sum(rates[-3:]) / 3 > 0.6, rates
