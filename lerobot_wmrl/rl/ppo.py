"""Proximal policy optimisation of any StochasticPolicy. T time, B environments or decisions."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import mean_and_variance
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.minibatches import Batch
from lerobot_wmrl.rl.policy_gradient import POLICY, PolicyGradient
from lerobot_wmrl.rl.return_scale import ReturnScale
from lerobot_wmrl.rl.rollout import RolloutBuffer


def generalised_advantages(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    gae_lambda: float,
    decided: Tensor | None = None,
) -> Tensor:
    """Return A_t = δ_t + γλ A_{t+1}, δ_t = r_t + γ V(o_{t+1}) − V(o_t) (Schulman et al. 2016, eq. 16).

    Args:
        reward, value: r_t and V(o_t). All tensors are (T, B).
        next_value: V(o_{t+1}), at an episode's last step that of its final observation.
        terminated: the episode ended, so V(o_{t+1}) counts as 0.
        truncated: the episode was cut, and V(o_{t+1}) counts. After either, row t + 1 belongs to another
            episode, so A_{t+1} is not added.
        gamma, gae_lambda: γ and λ.
        decided: where the policy made a decision; elsewhere the action chunk of an earlier one goes on. A
            chunk of n steps has δ = Σ_{i<n} γ^i r_{t+i} + γ^n V(o_{t+n}) − V(o_t). Its advantage is in the
            row of the decision; the other rows have no meaning.
    """
    alive = (~terminated).to(value.dtype)  # (T, B)
    same_episode = (~(terminated | truncated)).to(value.dtype)  # (T, B)
    advantages = torch.empty_like(value)
    running = torch.zeros_like(value[0])  # (B,)
    for step in reversed(range(len(value))):
        future = next_value[step] * alive[step] + gae_lambda * same_episode[step] * running
        if decided is not None and step + 1 < len(value):
            # where the chunk goes on, this sum is the return of its remaining steps
            continued = ~(decided[step + 1] | terminated[step] | truncated[step])
            future = torch.where(continued, advantages[step + 1] + value[step + 1], future)
        running = reward[step] + gamma * future - value[step]
        advantages[step] = running
    return advantages


def normalised(advantages: Tensor, chosen: Tensor) -> Tensor:
    """Scale to mean 0 and standard deviation 1 over the `chosen` steps of all processes. (T, B) → (T, B)"""
    mean, variance = mean_and_variance(advantages[chosen])
    return (advantages - mean) / (variance.sqrt() + 1e-8)


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Return Huber's loss: quadratic up to an error of 1, linear beyond. (B,) → (B,)"""
    return F.huber_loss(value, target, reduction="none")


class PPO(PolicyGradient):
    """Clipped objective on generalised advantages. The value function is trained beside the policy, and alone
    in the first `value_iterations`. With `value_normalisation` it predicts returns that `return_scale` has
    normalised."""

    config_class = PPOConfig
    name = "ppo"
    config: PPOConfig

    def __init__(self, policy: Any, config: PPOConfig) -> None:
        super().__init__(policy, config)
        if not any(parameter.requires_grad for parameter in self.value_parameters):
            raise FieldError(
                "peft.full_training_modules",
                None,
                "adapters leave the value function as it is, and PPO trains it",
                "name its module there (`critic` of a cnn policy, `value_head` of OpenVLA), or take grpo",
            )
        self.return_scale = ReturnScale()

    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """Return two groups: the value function has a learning rate and a gradient norm of its own."""
        return {
            POLICY: (self.policy_parameters, self.config.policy_lr),
            "value": (self.value_parameters, self.config.value_lr),
        }

    def trained_groups(self) -> list[str]:
        """Leave the policy out in the first `value_iterations`."""
        return ["value"] if self.value_only else super().trained_groups()

    @property
    def value_only(self) -> bool:
        """Whether this iteration trains the value function alone."""
        return self.iteration < self.config.value_iterations

    @torch.no_grad()
    def add_targets(self, rollout: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Add normalised advantages and the value's targets. All decisions are trained on."""
        config, decided, scale = self.config, rollout.decided, self.return_scale
        value, next_value = scale.restore(rollout.value), scale.restore(rollout.next_value)  # (T, B)
        advantages = generalised_advantages(
            rollout.reward,
            value,
            next_value,
            rollout.terminated,
            rollout.truncated,
            config.discount(rollout.longest),
            config.gae_lambda,
            decided,
        )
        target = advantages + value  # (T, B), the λ-returns
        if config.value_normalisation:
            scale.update(target[decided])
        rollout.columns = {
            "advantage": normalised(advantages, decided),
            "target": scale.normalise(target),
        }
        unexplained = mean_and_variance(advantages[decided])[1]
        total = mean_and_variance(target[decided])[1]
        return decided, {
            "value": mean_and_variance(value[decided])[0].item(),
            "explained_variance": 1 - (unexplained / total.clamp_min(1e-12)).item(),
        }

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the clipped objective with its penalty, plus the value's loss (eq. 9 without entropy)."""
        loss, record, value = self.policy_losses(batch, self.config.clip, self.config.clip)
        record["value_loss"] = value_loss(value, batch["target"])
        return (record["value_loss"] if self.value_only else loss + record["value_loss"]), record

    def state_dict(self) -> dict[str, Tensor]:
        """Add the moments of the returns, in whose units the value function predicts."""
        scale = {f"returns.{name}": value for name, value in self.return_scale.tensors.items()}
        return {**super().state_dict(), **scale}
