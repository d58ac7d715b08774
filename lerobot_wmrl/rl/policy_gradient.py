"""What PPO and GRPO share: policy and reference, the optimiser, the update and reasons to stop.

T time, B environments or decisions, K action components, J ratios of a decision. In several processes
gradients and metrics are averaged over all of them.
"""

import logging
import math
import time
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium as gym
import torch
import torch.nn.functional as F
from lerobot.rl.algorithms.configs import TrainingStats
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer
from tqdm import tqdm

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.distributed import (
    average_gradients,
    hidden_progress,
    largest_over_processes,
    mean_and_variance,
    mean_over_processes,
)
from lerobot_wmrl.common.errors import FieldError, TrainingStopped, within
from lerobot_wmrl.common.pipeline import Pipeline, unchanged
from lerobot_wmrl.common.policies import frozen_copy
from lerobot_wmrl.common.precision import require_exact_updates
from lerobot_wmrl.rl.algorithm import Algorithm
from lerobot_wmrl.rl.compatibility import check_std, require_encoder
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig
from lerobot_wmrl.rl.minibatches import Batch, Minibatch, Minibatches, read_batch
from lerobot_wmrl.rl.objective import (
    clipped_objective,
    kl_estimate,
    log_ratios,
    outside_clip,
    reference_penalty,
    steps_of,
)
from lerobot_wmrl.rl.observations import as_read_back
from lerobot_wmrl.rl.policy_adapters import as_stochastic
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from lerobot_wmrl.rl.trust_region import TrustRegion

GRAD_CLIP_NORM = 1.0
"""Largest gradient norm, of the policy's parameters and of the value's separately."""

POLICY = "policy"
"""The parameter group of the policy."""

REFERENCE, EXECUTED = "reference_log_prob", "executed"
RATIO_ERROR, LOSS, NORM = "ratio_error", "_loss", "_grad_norm"


class PolicyGradient(Algorithm):
    """Ascent on a clipped objective, with a KL penalty towards the SFT policy, the frozen `reference`.

    An iteration is `rollout.collect`, `make_minibatches`, then `update`. Subclasses say what the advantages
    are (`add_targets`) and what else is in the loss (`losses`).

    Args:
        policy: LeRobot's policy, trained in place and kept as `lerobot_policy`. `self.policy` is a
            StochasticPolicy: the same object, or an adapter around it. `self.reference` is a copy of
            `self.policy` before training, the SFT policy.
        config: the algorithm's configuration.
    """

    config: PolicyGradientConfig

    unrewarded: Tensor
    """Rollouts in a row, up to the latest, without a signal. () int64"""

    without_signal: ClassVar[str] = "no episode was rewarded"
    """What a rollout without a signal is like."""

    def __init__(self, policy: Any, config: PolicyGradientConfig) -> None:
        super().__init__(policy)
        self.policy, self.config = as_stochastic(policy), config
        self.unrewarded = torch.zeros((), dtype=torch.int64)
        if config.initial_std is not None:
            check_std(policy, self.policy, config.initial_std)
            with within("algorithm"):
                self.policy.set_std(config.initial_std)
        if not config.train_encoder:
            require_encoder(self.policy)
            self.policy.freeze_encoder()
        self.policy.eval()
        self.reference = frozen_copy(self.policy)
        self.value_parameters = list(self.policy.value_parameters())
        owned = {id(parameter) for parameter in self.value_parameters}
        self.policy_parameters = [
            p for p in self.policy.parameters() if p.requires_grad and id(p) not in owned
        ]
        if not (config.train_encoder or self.policy_parameters):
            raise FieldError(
                "algorithm.train_encoder",
                config.train_encoder,
                "leaves nothing of the policy to train: its adapters are all in the encoder",
                "set it to true, or give adapters to other layers (`peft.target_modules`)",
            )
        require_exact_updates(self.policy_parameters)
        self.optimizer = self.make_optimizers_and_scheduler()[self.name]
        group = list(self.parameter_groups()).index(POLICY)
        self.trust_region = TrustRegion(self.policy_parameters, self.optimizer, group, config.target_kl)

    @property
    def group_size(self) -> int:
        """Neighbouring environments that start from the same state."""
        return 1

    @abstractmethod
    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """Return parameters and learning rates by name."""

    def make_optimizers_and_scheduler(self) -> dict[str, Optimizer]:
        """Return AdamW with a constant rate for each parameter group."""
        groups = [{"params": params, "lr": rate} for params, rate in self.parameter_groups().values()]
        return {self.name: AdamW(groups, weight_decay=0.0)}

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors that the policy's own checkpoint lacks, its adapter's among them. Subclasses add
        theirs."""
        added = {} if self.policy is self.lerobot_policy else self.policy.own_tensors()
        return {"unrewarded": self.unrewarded, **{f"adapter.{name}": value for name, value in added.items()}}

    @torch.no_grad()
    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        """Copy the tensors of `state_dict` into this algorithm's own."""
        tensors = self.state_dict()
        if state_dict.keys() != tensors.keys():
            raise ValueError(
                f"algorithm.type={self.name}: its tensors are {sorted(tensors)}, got {sorted(state_dict)}"
            )
        for name, value in tensors.items():
            value.copy_(state_dict[name])

    def check_finite(self, record: dict[str, float]) -> None:
        """Raise TrainingStopped if a logged number is not finite."""
        broken = [name for name, value in record.items() if not math.isfinite(value)]
        if broken:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: {', '.join(broken)} is not finite; the last checkpoint is "
                "kept: lower `algorithm.policy_lr`, or `algorithm.value_lr` of PPO"
            )

    def check_reference_kl(self, kl: float) -> None:
        """Raise TrainingStopped if the policy is further from the SFT policy than `max_reference_kl`."""
        if kl > self.config.max_reference_kl:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: the policy is {kl:.3g} nats a step from the "
                f"SFT policy, above `algorithm.max_reference_kl` ({self.config.max_reference_kl}); raise "
                "`algorithm.reference_coefficient` or lower `algorithm.policy_lr`",
                before_update=True,
            )

    def signal(self, rollout: RolloutBuffer) -> Tensor:
        """Return a number above 0 if there is something to learn from. ()"""
        return rollout.reward.abs().max()

    def check_signal(self, rollout: RolloutBuffer) -> None:
        """Raise TrainingStopped after `patience` rollouts in a row without a signal."""
        self.unrewarded += 1
        if largest_over_processes(self.signal(rollout)).item() > 0:
            self.unrewarded.zero_()
        if self.unrewarded >= self.config.patience:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: {self.without_signal} in {self.unrewarded} iterations, "
                "so there is nothing to learn from. If imagination sees no success, lower "
                "`env.done_threshold`, or train the world model longer or on more successes; if the policy "
                "has none, take one that has, or raise `algorithm.initial_std`",
                before_update=True,
            )

    def trained_groups(self) -> list[str]:
        """Return the names of the parameter groups that this iteration trains."""
        return list(self.parameter_groups())

    @abstractmethod
    def add_targets(self, rollout: RolloutBuffer) -> tuple[Tensor, dict[str, float]]:
        """Add the advantages, and other columns that `losses` needs, to the rollout. Return the decisions to
        train on, (T, B) bool, and metrics."""

    @abstractmethod
    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of each decision (B,), and its metrics, (B,) by name."""

    def iterate(
        self, env: gym.vector.VectorEnv, pipeline: Pipeline, rollout: RolloutBuffer, seed: int, last: bool
    ) -> dict[str, float]:
        started = time.perf_counter()
        pipeline = self.with_frozen_encoder(pipeline)
        collected = collect(env, self.policy, pipeline, rollout, seed, self.group_size)
        rollout_end = time.perf_counter()
        self.check_signal(rollout)
        minibatches, targets = self.make_minibatches(rollout, pipeline)
        progress = tqdm(minibatches, "update", leave=False, unit="minibatch", disable=hidden_progress())
        stats = self.update(iter(progress))
        progress.close()
        return {
            **collected,
            **targets,
            **stats.to_log_dict(),
            "rollout_s": rollout_end - started,
            "update_s": time.perf_counter() - rollout_end,
        }

    def with_frozen_encoder(self, pipeline: Pipeline) -> Pipeline:
        """Return a pipeline that stores what the encoder makes of observations, where it does not learn."""
        if self.config.train_encoder:
            return pipeline

        def store(observation: Observation) -> Observation:
            encoded: Observation = self.policy.encode(pipeline.prepare(as_read_back(observation)))
            return encoded

        return replace(pipeline, prepare=unchanged, store=store)

    def make_minibatches(
        self, rollout: RolloutBuffer, pipeline: Pipeline
    ) -> tuple[Minibatches, dict[str, float]]:
        """Compute advantages and the reference's log-probabilities; return minibatches for `update`, and
        metrics.

        Raises:
            TrainingStopped: the policy is too far from the reference.
        """
        chosen, metrics = self.add_targets(rollout)
        metrics["reference_kl"] = self.add_reference(rollout, pipeline)
        self.check_finite({"reference_kl": metrics["reference_kl"]})
        self.check_reference_kl(metrics["reference_kl"])
        return Minibatches(rollout, chosen, pipeline, self.config), metrics

    @torch.no_grad()
    def add_reference(self, rollout: RolloutBuffer, pipeline: Pipeline) -> float:
        """Add the reference's log-probabilities of the actions, and which actions were executed.
        Return the mean KL of the policy to the reference."""
        reference = torch.zeros_like(rollout.log_prob)  # (T, B, K) or (T, B, n, K)
        rollout.columns[EXECUTED] = executed = rollout.executed()
        size = self.config.micro_batch_size or self.config.minibatch_size
        for rows in rollout.decided.flatten().nonzero()[:, 0].cpu().split(size):
            batch = read_batch(rollout, rows, pipeline)
            log_prob = self.reference.evaluate(batch["observation"], batch["raw_action"])[0]
            reference.flatten(0, 1)[rows.to(reference.device)] = log_prob
        rollout.columns[REFERENCE] = reference
        flat = [(each * executed).flatten(0, 1).flatten(1) for each in (rollout.log_prob, reference)]
        kl = kl_estimate(*flat) / steps_of(executed.flatten(0, 1))  # (T · B, K) each → (T · B,)
        return mean_and_variance(kl[rollout.decided.flatten()])[0].item()

    def update(self, batch_iterator: Iterator[Minibatch]) -> TrainingStats:
        """Take one optimiser step on each minibatch, until the KL to the rollout's policy exceeds
        `target_kl`. A step that is much too long is undone, and the next ones are shorter for a while."""
        records: list[dict[str, float]] = []
        first, within_target, region = self.optimization_step, False, self.trust_region
        region.forget()
        for minibatch in batch_iterator:
            self.optimizer.zero_grad()
            record = self.measure(minibatch, backward=True)
            if self.undone(record["kl"]):
                break
            self.check_finite(record)
            records.append({**record, "policy_lr": region.group["lr"]})
            if record["kl"] > self.config.target_kl:
                break
            if POLICY in self.trained_groups():
                region.remember()
            records[-1] |= self.optimizer_step()
        else:
            within_target = True
            if region.has_stepped:
                kl = self.measure(minibatch, backward=False)["kl"]
                within_target = not self.undone(kl) and kl <= self.config.target_kl
        region.forget()
        if within_target:
            region.recover()
        self.iteration += 1
        return training_stats(records, self.optimization_step - first)

    def undone(self, kl: float) -> bool:
        """Undo the last step if it has moved the policy much too far, and say so; return whether it did."""
        if not self.trust_region.undo_if_exceeded(kl):
            return False
        logging.info(
            "iteration %d: one step has moved the policy by %.3g nats, and is undone; its learning rate is "
            "now %.2g",
            self.iteration + 1,
            kl,
            self.trust_region.group["lr"],
        )
        return True

    def measure(self, minibatch: Minibatch, backward: bool) -> dict[str, float]:
        """Return the metrics of a minibatch; with `backward` accumulate the gradient of its mean loss too."""
        parts: list[dict[str, Tensor]] = []
        for counted, batch in minibatch.micro_batches():
            with torch.set_grad_enabled(backward):
                loss, record = self.losses(batch)  # (B,), (B,) by name; rows from `counted` on do not count
            if backward:
                loss[:counted].sum().div(minibatch.size).backward()
            parts.append({name: value.detach()[:counted] for name, value in record.items()})
        joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        largest_error = F.pad(joined.pop(RATIO_ERROR), (0, 1)).max()  # 0 where no decision counts
        means = torch.stack([value.sum() for value in joined.values()]).div(minibatch.size)
        metrics = mean_over_processes(dict(zip(joined, means.tolist(), strict=True)), means.device)
        return {**metrics, RATIO_ERROR: largest_over_processes(largest_error).item()}

    def policy_losses(
        self, batch: Batch, low: float, high: float
    ) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """Return the policy's loss of each decision, with the ratio clipped to [1 − low, 1 + high]; its
        metrics by name; and the value. All (B,)

        The actions are samples of the policy before the update. There the penalty's gradient is unbiased;
        after it, it is approximate.
        """
        log_prob, entropy, value = self.policy.evaluate(batch["observation"], batch["raw_action"])
        # (B, 1) or (B, n, 1). Not executed: ratio 1 and no gradient, but counted in the mean over ratios.
        executed = batch[EXECUTED]
        steps = steps_of(executed)
        now, old, reference = (
            (each * executed).flatten(1) for each in (log_prob, batch["log_prob"], batch[REFERENCE])
        )  # (B, K), or (B, n · K)
        log_ratio = log_ratios(now - old, self.config.ratio)  # (B, J)
        record = {
            "policy_loss": clipped_objective(log_ratio, batch["advantage"], low, high).mean(dim=1),
            "kl": kl_estimate(old, now) / steps,
            "entropy": entropy,
            "clip_fraction": outside_clip(log_ratio, low, high).mean(dim=1),
            RATIO_ERROR: (log_ratio.exp() - 1).abs().amax(dim=1),
        }
        penalty = self.config.reference_coefficient * reference_penalty(now, reference) / steps
        return record["policy_loss"] + penalty, record, value

    def optimizer_step(self) -> dict[str, float]:
        """Clip the gradients of each group, step, and return their norms.

        Raises:
            TrainingStopped: a gradient is not finite; no weights have changed.
        """
        trained, clipped = self.trained_groups(), {}
        for name, (parameters, _) in self.parameter_groups().items():
            if name in trained:
                average_gradients(parameters)
                clipped[name + NORM] = nn.utils.clip_grad_norm_(parameters, GRAD_CLIP_NORM)
            else:  # AdamW leaves parameters without a gradient alone
                for parameter in parameters:
                    parameter.grad = None
        norms = {name: norm.item() for name, norm in clipped.items()}
        self.check_finite(norms)
        self.optimizer.step()
        self.optimization_step += 1
        return norms


def training_stats(records: list[dict[str, float]], updates: int) -> TrainingStats:
    """Return each metric's mean over minibatches, and the first minibatch's ratio error, which is 0 up to
    rounding if `sample` and `evaluate` agree."""
    names = dict.fromkeys(name for record in records for name in record)
    by_name = {name: [record[name] for record in records if name in record] for name in names}
    mean = {name: sum(values) / len(values) for name, values in by_name.items()}
    losses = {name: mean.pop(name) for name in names if name.endswith(LOSS)}
    norms = {name.removesuffix(NORM): mean.pop(name) for name in names if name.endswith(NORM)}
    first = {"first_ratio_error": records[0][RATIO_ERROR]} if records else {}
    return TrainingStats(losses, norms, extra={**mean, **first, "updates": float(updates)})
