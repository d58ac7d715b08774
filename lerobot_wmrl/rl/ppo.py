"""Proximal policy optimisation of any StochasticPolicy. T time, B environments or decisions."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import mean_and_variance
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.policy_gradient import Batch, PolicyGradient
from lerobot_wmrl.rl.return_scale import ReturnScale
from lerobot_wmrl.rl.rollout import RolloutBuffer


def generalised_advantages(
    reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, truncated: Tensor,
    gamma: float, gae_lambda: float, decided: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Return A_t = δ_t + γλ A_{t+1}, δ_t = r_t + γ V(o_{t+1}) − V(o_t) (Schulman et al. 2016, eq. 16).

    Args:
        reward, value: r_t and V(o_t). All tensors are (T, B).
        next_value: V(o_{t+1}), at an episode's last step that of its final observation.
        terminated: the future is worth 0.
        truncated: the episode was cut, so V(o_{t+1}) counts. Neither lets the next episode's A_{t+1} through.
        gamma, gae_lambda: γ and λ.
        decided: where the policy made a decision; elsewhere an action chunk of an earlier step is executed.
            A chunk of n steps has δ = Σ_{i<n} γ^i r_{t+i} + γ^n V(o_{t+n}) − V(o_t). Its advantage is A_t of
            the step of the decision; the other rows have no meaning.
    """
    alive = (~terminated).to(value.dtype)
    connected = (~(terminated | truncated)).to(value.dtype)
    advantages = torch.empty_like(value)
    running = torch.zeros_like(value[0])  # (B,)
    for step in reversed(range(len(value))):
        onward = next_value[step] * alive[step] + gae_lambda * connected[step] * running
        if decided is not None and step + 1 < len(value):
            continued = ~(decided[step + 1] | terminated[step] | truncated[step])
            onward = torch.where(continued, advantages[step + 1] + value[step + 1], onward)
        running = reward[step] + gamma * onward - value[step]
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
    """Advantages from a value function, which is trained beside the policy, alone in the first
    `value_iterations`. With `value_normalisation` the policy's value is in units of `return_scale`."""

    config_class = PPOConfig
    name = "ppo"
    config: PPOConfig

    def __init__(self, policy: Any, config: PPOConfig) -> None:
        super().__init__(policy, config)
        self.return_scale = ReturnScale(self.value_parameters[0].device)

    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """Return the policy and the value function, each with its learning rate."""
        return {
            "policy": (self.policy_parameters, self.config.policy_lr),
            "value": (self.value_parameters, self.config.value_lr),
        }

    def trained_groups(self) -> list[str]:
        """Return both names, or the value's alone in the first iterations."""
        return ["value"] if self.value_only else super().trained_groups()

    @property
    def value_only(self) -> bool:
        """Whether this iteration trains the value function alone."""
        return self.iteration < self.config.value_iterations

    @torch.no_grad()
    def add_targets(self, rollout: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Add advantages and the value's targets. All decisions are trained on."""
        config, decided, scale = self.config, rollout.decided, self.return_scale
        value, next_value = scale.restore(rollout.value), scale.restore(rollout.next_value)  # (T, B)
        advantages = generalised_advantages(
            rollout.reward, value, next_value, rollout.terminated, rollout.truncated,
            config.gamma, config.gae_lambda, decided,
        )  # fmt: skip
        target = advantages + value
        if config.value_normalisation:
            scale.update(target[decided])
        rollout.columns = {
            "advantage": normalised(advantages, decided),
            "target": scale.normalise(target),
        }
        missed, spread = mean_and_variance(advantages[decided])[1], mean_and_variance(target[decided])[1]
        return decided, {
            "value": mean_and_variance(value[decided])[0].item(),
            "explained_variance": 1 - (missed / spread.clamp_min(1e-12)).item(),
        }

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the clipped objective with its penalty, plus the value's loss (eq. 9 without entropy)."""
        loss, record, value = self.policy_losses(batch, self.config.clip, self.config.clip)
        record["value_loss"] = value_loss(value, batch["target"])
        return (record["value_loss"] if self.value_only else loss + record["value_loss"]), record

    def state_dict(self) -> dict[str, Tensor]:
        """Return the scale of the returns too."""
        scale = {f"returns.{name}": value for name, value in self.return_scale.tensors.items()}
        return {**super().state_dict(), **scale}
