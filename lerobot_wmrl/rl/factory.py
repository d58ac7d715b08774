"""Algorithms by their configurations."""

from typing import Any

from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.configuration_policy_gradient import PolicyGradientConfig
from lerobot_wmrl.rl.grpo import GRPO
from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.ppo import PPO


def make_algorithm(policy: Any, config: PolicyGradientConfig, iterations: int) -> PolicyGradient:
    """What `config` describes, to train `policy` for so many iterations."""
    algorithm: type[PolicyGradient] = GRPO if isinstance(config, GRPOConfig) else PPO
    return algorithm(policy, config, iterations)
