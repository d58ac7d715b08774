"""Policies that cannot sample by themselves, and what makes them."""

from typing import Any

from lerobot_wmrl.common.adapters import unwrapped
from lerobot_wmrl.rl.act_adapter import ActAdapter
from lerobot_wmrl.rl.protocol import StochasticPolicy

ADAPTERS = {"act": ActAdapter}
"""By the policy's type. An adapter is a StochasticPolicy whose `own_tensors` are not in the policy's
checkpoint."""


def stochastic(policy: Any) -> Any:
    """The policy itself, or in its adapter. ValueError if it has none."""
    suitable: bool = isinstance(unwrapped(policy), StochasticPolicy)
    if suitable:
        return policy
    if policy.config.type not in ADAPTERS:
        raise ValueError(
            f"policy.type={policy.config.type}: reinforcement learning needs a policy with `sample`, "
            f"`evaluate`, `value` and `value_parameters`, for example cnn, or one of {', '.join(ADAPTERS)}"
        )
    return ADAPTERS[policy.config.type](policy)
