"""Group relative policy optimisation of any StochasticPolicy. T time, B environments, G of a group."""

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import mean_over_processes
from lerobot_wmrl.rl.advantages import group_advantages
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.minibatches import Steps
from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.rollout import RolloutBuffer


class GRPO(PolicyGradient):
    """A decision's advantage is its whole episode's, among the group's episodes from the same start.

    Each environment's first episode counts: later ones of a rollout begin elsewhere.
    """

    config_class = GRPOConfig
    name = "grpo"
    config: GRPOConfig

    @property
    def group_size(self) -> int:
        return self.config.group_size

    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        return {"policy": (self.policy_parameters, self.config.policy_lr)}

    @torch.no_grad()
    def add_targets(self, buffer: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Advantages within groups; only those with a signal are trained on."""
        returns = (buffer.reward * buffer.first_episode).sum(dim=0)
        advantages, signal = group_advantages(
            returns.view(-1, self.config.group_size), self.config.least_group_std
        )
        buffer.columns = {"advantage": advantages.flatten().expand(buffer.steps, -1)}
        learnt_from = signal.repeat_interleave(self.config.group_size)
        chosen = buffer.decided & buffer.first_episode & learnt_from
        numbers = {
            "return": returns.mean().item(),
            "groups_with_signal": signal.float().mean().item(),
            "decisions": chosen.float().mean().item(),
        }
        return chosen, mean_over_processes(numbers, buffer.device)

    def losses(self, batch: Steps) -> tuple[Tensor, dict[str, Tensor]]:
        found = self.evaluate(batch)
        return self.policy_losses(found, batch, self.config.clip_low, self.config.clip_high)
