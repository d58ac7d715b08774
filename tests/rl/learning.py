"""What it means that an algorithm learns."""

import gymnasium as gym

from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.protocol import Pipeline
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect


def assert_it_learns(
    algorithm: PolicyGradient, env: gym.vector.VectorEnv, buffer: RolloutBuffer, pipeline: Pipeline,
    iterations: int,
) -> None:  # fmt: skip
    """Its policy fails at first and mostly succeeds in the end."""
    rates = []
    for iteration in range(iterations):
        first = buffer.num_envs * iteration
        found = collect(env, algorithm.policy, pipeline, buffer, first, algorithm.group_size)
        rates.append(found["success_rate"])
        algorithm.improve(buffer, pipeline)
    assert max(rates[:2]) < 0.3
    assert sum(rates[-3:]) / 3 > 0.6, rates
