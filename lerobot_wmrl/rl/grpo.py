"""Group relative policy optimisation of any StochasticPolicy. T time, B environments, G of a group."""

from typing import ClassVar

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import mean_over_processes
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.minibatches import Batch
from lerobot_wmrl.rl.policy_gradient import POLICY, PolicyGradient
from lerobot_wmrl.rl.rollout import RolloutBuffer


def group_advantages(returns: Tensor, least_std: float) -> tuple[Tensor, Tensor]:
    """Return (R − mean) / std within each group (Shao et al. 2024, section 4.1.2), and which have a signal.

    Args:
        returns: returns of each episode, (B / G, G).
        least_std: groups whose returns have a smaller standard deviation have no signal.

    Returns:
        Advantages (B / G, G), 0 in groups without a signal, and the signal (B / G,) bool.
    """
    deviation = returns - returns.mean(dim=1, keepdim=True)
    std = deviation.square().mean(dim=1, keepdim=True).sqrt()  # (B / G, 1)
    signal = std >= least_std
    return torch.where(signal, deviation / std.clamp_min(1e-8), 0), signal[:, 0]


class GRPO(PolicyGradient):
    """Clipped objective on advantages within groups. Every decision of an episode has the same advantage: the
    episode's return compared with those of its group, which started from the same state. Only the first
    episode of each environment counts, because later ones start elsewhere."""

    config_class = GRPOConfig
    name = "grpo"
    config: GRPOConfig
    without_signal: ClassVar[str] = "in no group did returns differ by `algorithm.least_group_std`"

    @property
    def group_size(self) -> int:
        """Neighbouring environments that start from the same state."""
        return self.config.group_size

    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """Return the policy alone: a value function that it has is not trained."""
        return {POLICY: (self.policy_parameters, self.config.policy_lr)}

    def compare(self, rollout: RolloutBuffer) -> tuple[Tensor, Tensor, Tensor]:
        """Return the episodes' returns (B,), their advantages within groups (B / G, G), and which groups have
        a signal (B / G,)."""
        returns = (rollout.reward * rollout.first_episode).sum(dim=0)
        groups = returns.view(-1, self.config.group_size)
        return returns, *group_advantages(groups, self.config.least_group_std)

    def signal(self, rollout: RolloutBuffer) -> Tensor:
        """Return 1 if there is a group with a signal, else 0. ()"""
        return self.compare(rollout)[2].any().float()

    @torch.no_grad()
    def add_targets(self, rollout: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Add advantages within groups. Only decisions of groups with a signal are trained on."""
        returns, advantages, signal = self.compare(rollout)
        rollout.columns = {"advantage": advantages.flatten().expand(rollout.steps, -1)}  # (T, B)
        with_signal = signal.repeat_interleave(self.config.group_size)  # (B,)
        chosen = rollout.decided & rollout.first_episode & with_signal
        metrics = {
            "return": returns.mean().item(),
            "groups_with_signal": signal.float().mean().item(),
            "decisions": chosen.float().mean().item(),
        }
        return chosen, mean_over_processes(metrics, rollout.device)

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the clipped objective with its penalty."""
        loss, record, _ = self.policy_losses(batch, self.config.clip_low, self.config.clip_high)
        return loss, record
