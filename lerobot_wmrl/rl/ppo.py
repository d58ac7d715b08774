"""Proximal policy optimisation of any StochasticPolicy. B decisions of a pass."""

from typing import Any

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import mean_and_variance
from lerobot_wmrl.rl.advantages import generalised_advantages, normalised
from lerobot_wmrl.rl.configuration_ppo import PPOConfig
from lerobot_wmrl.rl.minibatches import Steps
from lerobot_wmrl.rl.objectives import clipped_value_loss, huber_value_loss
from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.return_scale import ReturnScale
from lerobot_wmrl.rl.rollout import RolloutBuffer


class PPO(PolicyGradient):
    """Advantages by a value, which learns beside the policy: in the first `value_iterations` it alone.

    With `value_normalisation` the policy's value is in the returns' units only by `returns`.
    """

    config_class = PPOConfig
    name = "ppo"
    config: PPOConfig

    def __init__(self, policy: Any, config: PPOConfig, iterations: int | None = None) -> None:
        super().__init__(policy, config, iterations)
        self.returns = ReturnScale(self.value_parameters[0].device)

    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        return {
            "policy": (self.policy_parameters, self.config.policy_lr),
            "value": (self.value_parameters, self.config.value_lr),
        }

    @property
    def value_only(self) -> bool:
        """Whether the policy waits for the value to mean something."""
        return self.iteration < self.config.value_iterations

    def trained(self) -> list[str]:
        return ["value"] if self.value_only else super().trained()

    @torch.no_grad()
    def add_targets(self, buffer: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Advantages and the value's targets."""
        config, decided = self.config, buffer.decided
        value, next_value = self.returns.restore(buffer.value), self.returns.restore(buffer.next_value)
        advantages = generalised_advantages(
            buffer.reward, value, next_value, buffer.terminated, buffer.truncated,
            config.gamma, config.gae_lambda, decided,
        )  # fmt: skip
        target = advantages + value
        if config.value_normalisation:
            self.returns.update(target[decided])
        buffer.columns = {
            "advantage": normalised(advantages, decided),
            "target": self.returns.normalise(target),
            "old_value": buffer.value,
        }
        missed, spread = mean_and_variance(advantages[decided])[1], mean_and_variance(target[decided])[1]
        explained = 1 - (missed / spread.clamp_min(1e-12)).item()
        return decided, {
            "value": mean_and_variance(value[decided])[0].item(),
            "explained_variance": explained,
        }

    def losses(self, batch: Steps) -> tuple[Tensor, dict[str, Tensor]]:
        found = self.evaluate(batch)
        loss, record = self.policy_losses(found, batch, self.config.clip, self.config.clip)
        record["value_loss"] = self._value_loss(found.value, batch)
        return (record["value_loss"] if self.value_only else loss + record["value_loss"]), record

    def _value_loss(self, value: Tensor, batch: Steps) -> Tensor:
        if self.config.value_loss == "huber":
            return huber_value_loss(value, batch["target"])
        return clipped_value_loss(value, batch["target"], batch["old_value"], self.config.value_clip)

    def state_dict(self) -> dict[str, Tensor]:
        """The scale of the returns too."""
        scale = {f"returns.{name}": value for name, value in self.returns.tensors.items()}
        return {**super().state_dict(), **scale}
