"""Proximal policy optimisation of any StochasticPolicy. B steps of a minibatch, K action components."""

import copy
from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.rl.algorithms.base import RLAlgorithm
from lerobot.rl.algorithms.configs import TrainingStats
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from lerobot_wmrl.rl.advantages import generalised_advantages, normalised
from lerobot_wmrl.rl.configuration_ppo import PPOConfig
from lerobot_wmrl.rl.protocol import Pipeline, StochasticPolicy
from lerobot_wmrl.rl.rollout import Minibatch, RolloutBuffer

REFERENCE = "reference_log_prob"


class TrainingStopped(ValueError):
    """Training cannot go on; the last checkpoint is good."""


def clipped_objective(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """Schulman et al. 2017, eq. 7, as a loss: −min(r A, clip(r) A), r = exp(log_ratio). (B,), (B,) → ()"""
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def kl_estimate(log_prob: Tensor, other: Tensor) -> Tensor:
    """KL(sampling ‖ other) from samples: r − 1 − log r, r = other / sampling (Schulman 2020). (B, K) → ()"""
    log_ratio = (other - log_prob).sum(dim=1)
    return (log_ratio.exp() - 1 - log_ratio).mean()


def reference_penalty(log_prob: Tensor, reference: Tensor) -> Tensor:
    """½ (log π − log π_ref)², whose gradient on π's samples is that of KL(π ‖ π_ref). (B, K) → ()"""
    return 0.5 * (log_prob - reference).square().sum(dim=1).mean()


class PPO(RLAlgorithm):
    """Improves `policy` from rollouts, held near the policy as it was given: the cloned one.

    `iteration` counts finished rollouts; the first `value_iterations` of them only train the value.
    """

    config_class = PPOConfig
    name = "ppo"

    def __init__(self, policy: Any, config: PPOConfig) -> None:
        self.policy: Any = policy
        suitable: bool = isinstance(policy, StochasticPolicy)
        if not suitable:
            raise ValueError(
                f"policy.type={policy.config.type}: PPO needs a policy with `sample`, `evaluate`, `value` "
                "and `value_parameters`, for example cnn"
            )
        self.config = config
        self.iteration = 0
        if config.initial_std is not None:
            if not hasattr(policy, "set_std"):
                raise ValueError("algorithm.initial_std: this policy has no standard deviation, leave it out")
            policy.set_std(config.initial_std)
        self.policy.eval()
        self.reference: Any = copy.deepcopy(self.policy).requires_grad_(False)
        self.value_parameters = list(policy.value_parameters())
        owned = {id(parameter) for parameter in self.value_parameters}
        self.policy_parameters = [
            p for p in self.policy.parameters() if p.requires_grad and id(p) not in owned
        ]
        self.optimizer = self.make_optimizers_and_scheduler()["ppo"]

    def make_optimizers_and_scheduler(self) -> dict[str, Optimizer]:
        groups = [
            {"params": self.policy_parameters, "lr": self.config.policy_lr},
            {"params": self.value_parameters, "lr": self.config.value_lr},
        ]
        return {"ppo": AdamW(groups, weight_decay=0.0)}

    def get_optimizers(self) -> dict[str, Optimizer]:
        return {"ppo": self.optimizer}

    @property
    def value_only(self) -> bool:
        """Whether the policy waits for the value to mean something."""
        return self.iteration < self.config.value_iterations

    def improve(self, buffer: RolloutBuffer, pipeline: Pipeline) -> TrainingStats:
        """One iteration's updates from a filled buffer."""
        self._add_targets(buffer, pipeline)
        config = self.config
        stats = self.update(buffer.minibatches(config.minibatch_size, config.epochs, pipeline))
        residual = buffer.columns["target"] - buffer.value
        stats.extra["explained_variance"] = 1 - (residual.var() / buffer.columns["target"].var()).item()
        self.iteration += 1
        return stats

    @torch.no_grad()
    def _add_targets(self, buffer: RolloutBuffer, pipeline: Pipeline) -> None:
        """Advantages, value targets and the reference's log-probs of what was done."""
        advantages = generalised_advantages(
            buffer.reward, buffer.value, buffer.next_value, buffer.terminated, buffer.truncated,
            self.config.gamma, self.config.gae_lambda,
        )  # fmt: skip
        reference = torch.empty_like(buffer.log_prob)
        for rows in torch.arange(reference.shape[0] * reference.shape[1], device=reference.device).split(
            self.config.minibatch_size
        ):
            batch = buffer.minibatch(rows, pipeline)
            log_prob = self.reference.evaluate(batch["observation"], batch["raw_action"])[0]
            reference.view(-1, reference.shape[-1])[rows] = log_prob
        target = advantages + buffer.value
        buffer.columns = {"advantage": normalised(advantages), "target": target, REFERENCE: reference}

    def update(self, batch_iterator: Iterator[Minibatch]) -> TrainingStats:
        """Descend on each minibatch until they end or the policy has moved by `target_kl`."""
        records: list[dict[str, Tensor]] = []
        first = self.optimization_step
        for batch in batch_iterator:
            loss, record = self.losses(batch)
            records.append({name: value.detach() for name, value in record.items()})
            self._check(records[-1])
            if record["kl"] > self.config.target_kl:
                break
            self._descend(loss)
        mean = {name: torch.stack([record[name] for record in records]).mean().item() for name in records[0]}
        losses = {name: mean.pop(name) for name in ("policy_loss", "value_loss")}
        extra = {
            **mean,
            "first_ratio_error": records[0]["ratio_error"].item(),
            "updates": float(self.optimization_step - first),
        }
        return TrainingStats(losses=losses, extra=extra)

    def losses(self, batch: Minibatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The total loss of a minibatch, and its parts. The ratio is per action: its components' product."""
        log_prob, entropy, value = self.policy.evaluate(batch["observation"], batch["raw_action"])
        log_ratio = (log_prob - batch["log_prob"]).sum(dim=1)
        config = self.config
        record = {
            "policy_loss": clipped_objective(log_ratio, batch["advantage"], config.clip),
            "value_loss": F.huber_loss(value, batch["target"]),
            "kl": kl_estimate(batch["log_prob"], log_prob),
            "reference_kl": kl_estimate(log_prob, batch[REFERENCE]),
            "entropy": entropy.mean(),
            "ratio_error": (log_ratio.exp() - 1).abs().max(),
        }
        if self.value_only:
            return record["value_loss"], record
        penalty = config.reference_coefficient * reference_penalty(log_prob, batch[REFERENCE])
        loss = record["policy_loss"] + penalty - config.entropy_coefficient * record["entropy"]
        return loss + record["value_loss"], record

    def _descend(self, loss: Tensor) -> None:
        self.optimizer.zero_grad()
        loss.backward()
        for parameters in (self.policy_parameters, self.value_parameters):
            nn.utils.clip_grad_norm_(parameters, self.config.grad_clip_norm)
        self.optimizer.step()
        self.optimization_step += 1

    def _check(self, record: dict[str, Tensor]) -> None:
        """TrainingStopped before a step that would spoil the policy."""
        broken = [name for name, value in record.items() if not bool(value.isfinite())]
        if broken:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: {', '.join(broken)} is not finite; the last checkpoint is "
                "kept: lower algorithm.policy_lr or algorithm.value_lr"
            )
        if record["reference_kl"] > self.config.max_reference_kl:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: the policy is {record['reference_kl'].item():.1f} nats "
                f"from the cloned one, above algorithm.max_reference_kl={self.config.max_reference_kl}; "
                "raise algorithm.reference_coefficient or lower algorithm.policy_lr"
            )

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        self.policy.load_state_dict(weights)

    def state_dict(self) -> dict[str, Tensor]:
        """Nothing that is not the policy's or the optimiser's."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        if state_dict:
            raise ValueError(f"PPO owns no tensors, got {sorted(state_dict)}")
