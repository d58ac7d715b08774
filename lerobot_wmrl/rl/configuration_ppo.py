"""Configuration of PPO, `--algorithm.type=ppo`."""

from dataclasses import dataclass
from typing import Any

from lerobot.rl.algorithms.configs import RLAlgorithmConfig


@RLAlgorithmConfig.register_subclass("ppo")
@dataclass
class PPOConfig(RLAlgorithmConfig):
    """Proximal policy optimisation (Schulman et al. 2017) with a penalty for leaving the cloned policy.

    Args:
        gamma, gae_lambda: discount, and the λ of generalised advantage estimation.
        clip: half-width of the interval in which the ratio is free to move.
        epochs, minibatch_size: passes over each iteration's steps, and steps an update.
        policy_lr, value_lr: AdamW's learning rates; grad_clip_norm applies to each separately.
        value_iterations: first iterations, in which only the value learns.
        reference_coefficient: weight of KL(policy || cloned policy).
        entropy_coefficient: weight of the entropy bonus.
        target_kl: an iteration's updates stop once the policy has moved this far from its start.
        max_reference_kl: training stops beyond this distance from the cloned policy, in nats an action.
        initial_std: standard deviation of exploration, in normalised actions; None keeps the cloned one.
    """

    gamma: float = 0.97
    gae_lambda: float = 0.95
    clip: float = 0.2
    epochs: int = 3
    minibatch_size: int = 384
    policy_lr: float = 1e-4
    value_lr: float = 5e-4
    grad_clip_norm: float = 1.0
    value_iterations: int = 3
    reference_coefficient: float = 0.1
    entropy_coefficient: float = 0.0
    target_kl: float = 0.015
    max_reference_kl: float = 20.0
    initial_std: float | None = None

    def __post_init__(self) -> None:
        for name in ("gamma", "gae_lambda", "clip"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"algorithm.{name}={getattr(self, name)}: must be above 0 and at most 1")
        for name in ("epochs", "minibatch_size", "policy_lr", "value_lr", "grad_clip_norm", "target_kl"):
            if getattr(self, name) <= 0:
                raise ValueError(f"algorithm.{name}={getattr(self, name)}: must be above 0")

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> "PPOConfig":
        """The defaults: nothing in them depends on the policy."""
        return cls()
