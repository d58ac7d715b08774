"""What PPO and GRPO share: descent on a clipped objective, near the policy as it was given.

B decisions, K action components. Under `torchrun` every process has its own environments, and all take the
steps that one process with all of them would take.
"""

import copy
import math
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from lerobot.rl.algorithms.base import RLAlgorithm
from lerobot.rl.algorithms.configs import TrainingStats
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from lerobot_wmrl.common.adapters import load_trained_weights
from lerobot_wmrl.common.distributed import (
    largest_over_processes,
    mean_and_variance,
    sum_gradients,
    sum_over_processes,
)
from lerobot_wmrl.common.precision import require_exact_updates
from lerobot_wmrl.rl.configuration_policy_gradient import PolicyGradientConfig
from lerobot_wmrl.rl.minibatches import Minibatch, Steps, make_minibatches, read_steps
from lerobot_wmrl.rl.objectives import (
    clipped_objective,
    kl_estimate,
    log_ratios,
    outside_clip,
    reference_penalty,
)
from lerobot_wmrl.rl.protocol import Pipeline
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.stochastic_policies import stochastic

REFERENCE, EXECUTED = "reference_log_prob", "executed"
LOSS, NORM = "_loss", "_grad_norm"


class TrainingStopped(ValueError):
    """Training cannot go on; the last checkpoint is good."""


class Evaluated(NamedTuple):
    """What a policy says of decisions: log-probs (B, K) now, when sampled and of the reference, 0 where a
    component was not acted; entropies (B,) and values (B,)."""

    log_prob: Tensor
    old: Tensor
    reference: Tensor
    entropy: Tensor
    value: Tensor


class PolicyGradient(RLAlgorithm):
    """Improves a policy from rollouts. `iteration` counts the finished ones of `iterations`.

    `policy` samples; it is the policy that was `given`, or that in its adapter.
    """

    config: PolicyGradientConfig

    def __init__(self, policy: Any, config: PolicyGradientConfig, iterations: int | None = None) -> None:
        if config.lr_schedule != "constant" and iterations is None:
            raise ValueError(f"algorithm.lr_schedule={config.lr_schedule}: needs the number of iterations")
        self.given, self.policy = policy, stochastic(policy)
        self.config, self.iterations, self.iteration = config, iterations, 0
        if config.initial_std is not None:
            if not hasattr(self.policy, "set_std"):
                raise ValueError("algorithm.initial_std: this policy has no standard deviation, leave it out")
            self.policy.set_std(config.initial_std)
        self.policy.eval()
        self.reference = reference_of(self.policy)
        self.value_parameters = list(self.policy.value_parameters())
        owned = {id(parameter) for parameter in self.value_parameters}
        self.policy_parameters = [
            p for p in self.policy.parameters() if p.requires_grad and id(p) not in owned
        ]
        require_exact_updates(self.policy_parameters)
        self.optimizer = self.make_optimizers_and_scheduler()[self.name]

    @property
    def group_size(self) -> int:
        """Neighbouring environments that begin alike."""
        return 1

    @abstractmethod
    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """What is trained, by name, and its learning rate."""

    @abstractmethod
    def add_targets(self, buffer: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Fill the columns that `losses` needs. → decisions to train on (T, B) bool, numbers to log"""

    @abstractmethod
    def losses(self, batch: Steps) -> tuple[Tensor, dict[str, Tensor]]:
        """Each decision's loss and its parts. → (B,), (B,) by name"""

    def make_optimizers_and_scheduler(self) -> dict[str, Optimizer]:
        groups = [{"params": params, "lr": rate} for params, rate in self.parameter_groups().values()]
        return {self.name: AdamW(groups, weight_decay=0.0)}

    def get_optimizers(self) -> dict[str, Optimizer]:
        return {self.name: self.optimizer}

    def improve(self, buffer: RolloutBuffer, pipeline: Pipeline) -> TrainingStats:
        """One iteration's updates from a filled buffer."""
        config = self.config
        chosen, numbers = self.add_targets(buffer)
        numbers["reference_kl"] = self._add_reference(buffer, pipeline)
        factor = schedule_factor(config.lr_schedule, self.iteration, self.iterations)
        rates = [rate for _, rate in self.parameter_groups().values()]
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * factor
        stats = self.update(
            make_minibatches(
                buffer, chosen, pipeline, config.minibatch_size, config.micro_batch_size, config.epochs
            )
        )
        stats.extra = {**numbers, "policy_lr": config.policy_lr * factor, **stats.extra}
        self.iteration += 1
        return stats

    @torch.no_grad()
    def _add_reference(self, buffer: RolloutBuffer, pipeline: Pipeline) -> float:
        """The reference's log-probs of what was done, and which steps of decisions were. → KL from it"""
        reference = torch.zeros_like(buffer.log_prob)
        executed = buffer.executed()
        if executed is not None:
            buffer.columns[EXECUTED] = executed
        size = self.config.micro_batch_size or self.config.minibatch_size
        for rows in buffer.decided.flatten().nonzero()[:, 0].cpu().split(size):
            batch = read_steps(buffer, rows, pipeline)
            log_prob = self.reference.evaluate(batch["observation"], batch["raw_action"])[0]
            reference.flatten(0, 1)[rows.to(reference.device)] = log_prob
        buffer.columns[REFERENCE] = reference
        acted = 1.0 if executed is None else executed
        flat = [(each * acted).flatten(0, 1).flatten(1) for each in (buffer.log_prob, reference)]
        return mean_and_variance(kl_estimate(*flat)[buffer.decided.flatten()])[0].item()

    def update(self, batch_iterator: Iterator[Minibatch]) -> TrainingStats:
        """Descend on each minibatch until they end or the policy has moved by `target_kl`."""
        records: list[dict[str, float]] = []
        first = self.optimization_step
        for batch in batch_iterator:
            record = self._accumulate(batch)
            self._check(record)
            records.append(record)
            if record["kl"] > self.config.target_kl:
                break
            record |= self._descend()
        return summary(records, self.optimization_step - first)

    def _accumulate(self, batch: Minibatch) -> dict[str, float]:
        """The gradient of a minibatch's mean loss, pass by pass. → the means of its parts"""
        self.optimizer.zero_grad()
        parts: list[dict[str, Tensor]] = []
        for steps in batch.passes:
            loss, record = self.losses(steps)
            (loss * steps["weight"]).sum().div(batch.size).backward()
            parts.append({name: (value.detach() * steps["weight"]) for name, value in record.items()})
        names = [name for name in parts[0] if name != "ratio_error"]
        sums = torch.stack([torch.cat([part[name] for part in parts]).sum() for name in names])
        means = sum_over_processes(sums).div(batch.size)
        furthest = largest_over_processes(torch.stack([part["ratio_error"].max() for part in parts]).max())
        return dict(zip([*names, "ratio_error"], [*means.tolist(), furthest.item()], strict=True))

    def evaluate(self, batch: Steps) -> Evaluated:
        """The policy on what was done."""
        log_prob, entropy, value = self.policy.evaluate(batch["observation"], batch["raw_action"])
        acted = batch.get(EXECUTED, 1.0)
        now, old, reference = (
            (each * acted).flatten(1) for each in (log_prob, batch["log_prob"], batch[REFERENCE])
        )
        return Evaluated(now, old, reference, entropy, value)

    def policy_losses(
        self, found: Evaluated, batch: Steps, low: float, high: float
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The policy's loss of each decision, clipped at 1 − low and 1 + high, and its parts."""
        config = self.config
        log_ratio = log_ratios(found.log_prob - found.old, config.ratio)
        record = {
            "policy_loss": clipped_objective(log_ratio, batch["advantage"], low, high).mean(dim=1),
            "kl": kl_estimate(found.old, found.log_prob),
            "reference_kl": kl_estimate(found.log_prob, found.reference),
            "entropy": found.entropy,
            "clip_fraction": outside_clip(log_ratio, low, high).mean(dim=1),
            "ratio_error": (log_ratio.exp() - 1).abs().amax(dim=1),
        }
        penalty = config.reference_coefficient * reference_penalty(found.log_prob, found.reference)
        loss = record["policy_loss"] + penalty - config.entropy_coefficient * found.entropy
        return loss, record

    def trained(self) -> list[str]:
        """Names of the parameter groups that this iteration trains."""
        return list(self.parameter_groups())

    def _descend(self) -> dict[str, float]:
        """One step along the gradients, those of each group clipped. → their norms. TrainingStopped before it
        if they are not finite."""
        trained, clipped = self.trained(), {}
        for name, (parameters, _) in self.parameter_groups().items():
            if name not in trained:
                for parameter in parameters:
                    parameter.grad = None
                continue
            sum_gradients(parameters)
            clipped[name + NORM] = nn.utils.clip_grad_norm_(parameters, self.config.grad_clip_norm)
        norms = {name: norm.item() for name, norm in clipped.items()}
        self._check_finite(norms)
        self.optimizer.step()
        self.optimization_step += 1
        return norms

    def _check_finite(self, record: dict[str, float]) -> None:
        broken = [name for name, value in record.items() if not math.isfinite(value)]
        if broken:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: {', '.join(broken)} is not finite; the last checkpoint is "
                "kept: lower algorithm.policy_lr or algorithm.value_lr"
            )

    def _check(self, record: dict[str, float]) -> None:
        """TrainingStopped before a step that would spoil the policy."""
        self._check_finite(record)
        if record["reference_kl"] > self.config.max_reference_kl:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: the policy is {record['reference_kl']:.1f} nats "
                f"from the cloned one, above algorithm.max_reference_kl={self.config.max_reference_kl}; "
                "raise algorithm.reference_coefficient or lower algorithm.policy_lr"
            )

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        load_trained_weights(self.given, weights)

    def state_dict(self) -> dict[str, Tensor]:
        """What is not in the policy's checkpoint: an adapter's tensors, and what an algorithm adds."""
        added = {} if self.policy is self.given else self.policy.own_tensors()
        return {f"adapter.{name}": value for name, value in added.items()}

    @torch.no_grad()
    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        own = self.state_dict()
        if state_dict.keys() != own.keys():
            raise ValueError(
                f"algorithm.type={self.name}: its tensors are {sorted(own)}, got {sorted(state_dict)}"
            )
        for name, value in own.items():
            value.copy_(state_dict[name])


def reference_of(policy: Any) -> Any:
    """A copy that is not trained. It shares the parameters that the policy does not train either, as those
    under LoRA's."""
    frozen = {id(each): each for each in policy.parameters() if not each.requires_grad}
    return copy.deepcopy(policy, frozen).requires_grad_(False)


def schedule_factor(schedule: str, iteration: int, iterations: int | None) -> float:
    """Share of the learning rate in an iteration, counted from 0: 1 in the first, above 0 in the last."""
    if schedule == "constant" or iterations is None:
        return 1.0
    left = 1 - iteration / iterations
    return left if schedule == "linear" else 0.5 * (1 - math.cos(math.pi * left))


def summary(records: list[dict[str, float]], updates: int) -> TrainingStats:
    """Means over minibatches, the first one's ratio error apart."""
    names = dict.fromkeys(name for record in records for name in record)
    seen = {name: [record[name] for record in records if name in record] for name in names}
    mean = {name: sum(values) / len(values) for name, values in seen.items()}
    losses = {name: mean.pop(name) for name in names if name.endswith(LOSS)}
    norms = {name.removesuffix(NORM): mean.pop(name) for name in names if name.endswith(NORM)}
    first = {"first_ratio_error": records[0]["ratio_error"]} if records else {}
    return TrainingStats(losses, norms, extra={**mean, **first, "updates": float(updates)})
