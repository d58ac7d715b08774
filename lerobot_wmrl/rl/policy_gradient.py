"""What PPO and GRPO share: minibatches, the clipped objective, the KL penalty and the update.

T time, B environments or decisions, K action components, J ratios of a decision. In several processes each
one cuts minibatches from its own rollout, and gradients and metrics are averaged over all of them.
"""

import logging
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import torch
import torch.nn.functional as F
from lerobot.rl.algorithms.configs import TrainingStats
from torch import Tensor, nn
from tqdm import tqdm

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.distributed import (
    average_gradients,
    gather_counts,
    hidden_progress,
    largest_over_processes,
    mean_and_variance,
    mean_over_processes,
)
from lerobot_wmrl.common.pipeline import Pipeline, unchanged
from lerobot_wmrl.rl.algorithm import NORM, RATIO_ERROR, Algorithm, training_stats
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig
from lerobot_wmrl.rl.observations import as_read_back
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect

GRAD_CLIP_NORM = 1.0
"""Largest gradient norm, of the policy's parameters and of the value's separately."""

UNDONE_KL = 10.0
"""A step that moves the policy by more than this many times `target_kl` is undone."""

LEAST_LR_FACTOR = 0.1
"""The least factor by which the learning rate falls then. Estimates of a large KL are far too large."""

LR_RECOVERY = 1.1
"""Factor by which it rises again, up to `policy_lr`, in each iteration that stays within `target_kl`."""

POLICY = "policy"
"""The parameter group of the policy."""

REFERENCE, EXECUTED = "reference_log_prob", "executed"

Batch = dict[str, Any]
"""B decisions: `observation`, `raw_action`, `log_prob` and the buffer's columns."""


def log_ratios(log_prob_change: Tensor, kind: str) -> Tensor:
    """Return log-ratios of whole actions (B, 1) or of each token (B, K) from the components' (B, K)."""
    return log_prob_change if kind == "token" else log_prob_change.sum(dim=1, keepdim=True)


def clipped_objective(log_ratio: Tensor, advantage: Tensor, low: float, high: float) -> Tensor:
    """Return −min(r A, clip(r, 1 − low, 1 + high) A), r = exp(log_ratio) (Schulman et al. 2017, eq. 7).

    (B, J), (B,) → (B, J)
    """
    ratio, advantage = log_ratio.exp(), advantage[:, None]
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - low, 1 + high) * advantage)


def outside_clip(log_ratio: Tensor, low: float, high: float) -> Tensor:
    """Return 1 where a ratio has left the interval in which it may move. (B, J) → (B, J)"""
    ratio = log_ratio.exp()
    return ((ratio < 1 - low) | (ratio > 1 + high)).to(ratio.dtype)


def kl_estimate(log_prob: Tensor, other: Tensor) -> Tensor:
    """Estimate KL(p ‖ q) on samples of p by r − 1 − log r, r = q / p (Schulman 2020). (B, K), (B, K) → (B,)

    `log_prob` is log p of each component, `other` is log q.
    """
    log_ratio = (other - log_prob).sum(dim=1)
    return log_ratio.exp() - 1 - log_ratio


def reference_penalty(log_prob: Tensor, reference: Tensor) -> Tensor:
    """Return ½ Σ (log π − log π_ref)² over the components. (B, K), (B, K) → (B,)

    Its mean gradient on π's samples is that of KL(π ‖ π_ref) for independent components; per token it ignores
    what a token does to later ones.
    """
    return 0.5 * (log_prob - reference).square().sum(dim=1)


def steps_of(executed: Tensor) -> Tensor:
    """Return how many steps of a decision's actions were executed, at least 1. (B, n, 1) or (B, 1) → (B,)"""
    return executed.flatten(1).sum(dim=1).clamp_min(1)


def read_batch(rollout: RolloutBuffer, rows: Tensor, pipeline: Pipeline) -> Batch:
    """Return the decisions of flat rows t · B + b (N,), which are on the CPU."""
    on_device = rows.to(rollout.device)
    stored = {"raw_action": rollout.raw_action, "log_prob": rollout.log_prob, **rollout.columns}
    taken = {name: values.flatten(0, 1)[on_device] for name, values in stored.items()}
    return {"observation": pipeline.prepare(rollout.observations.read(rows)), **taken}


class Minibatch(NamedTuple):
    """Decisions of one optimiser step.

    Args:
        size: their number, averaged over the processes.
        parts: what they are cut into for micro-batches: rows of the rollout.
        read: returns the batch of such rows, and how many of its decisions count: the first ones.
    """

    size: float
    parts: Sequence[Tensor]
    read: Callable[[Tensor], tuple[int, Batch]]

    def micro_batches(self) -> Iterator[tuple[int, Batch]]:
        """Read one part after another."""
        return map(self.read, self.parts)


class Minibatches:
    """Every chosen decision of a rollout once an epoch, in random order.

    All processes get the same number of minibatches and micro-batches, even if they have chosen different
    numbers of decisions, because they average gradients and may share a large model.
    """

    def __init__(
        self, rollout: RolloutBuffer, chosen: Tensor, pipeline: Pipeline, config: PolicyGradientConfig
    ) -> None:
        self.rollout, self.pipeline, self.config = rollout, pipeline, config
        self.rows = chosen.flatten().nonzero()[:, 0].cpu()  # (T, B) bool → (N,)
        self.counts = gather_counts(len(self.rows), rollout.device)

    def __len__(self) -> int:
        return self.config.epochs * math.ceil(max(self.counts) / self.config.minibatch_size)

    def __iter__(self) -> Iterator[Minibatch]:
        size = self.config.minibatch_size
        for _ in range(self.config.epochs if max(self.counts) else 0):
            order = self.rows[torch.randperm(len(self.rows))]
            for first in range(0, max(self.counts), size):
                sizes = [min(max(count - first, 0), size) for count in self.counts]
                micro_batches = math.ceil(max(sizes) / (self.config.micro_batch_size or size))
                cut = order[first : first + size].tensor_split(micro_batches)
                yield Minibatch(sum(sizes) / len(sizes), cut, self._read)

    def _read(self, rows: Tensor) -> tuple[int, Batch]:
        """Return the number of rows and their batch. A process without rows left still runs the policy, on
        one row that does not count."""
        return len(rows), read_batch(self.rollout, rows if len(rows) else rows.new_zeros(1), self.pipeline)


class PolicyGradient(Algorithm):
    """Ascent on a clipped objective, with a KL penalty towards the SFT policy, the frozen `reference`.

    An iteration is `rollout.collect`, `prepare`, then `update`. Subclasses say what the advantages
    are (`add_targets`) and what else is in the loss (`losses`).
    """

    config: PolicyGradientConfig

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
        """Collect one rollout with the seeds from `seed` on, update the policy on it, and return metrics."""
        started = time.perf_counter()
        pipeline = self.encoding(pipeline)
        collected = collect(env, self.policy, pipeline, rollout, seed, self.group_size)
        rollout_end = time.perf_counter()
        minibatches, targets = self.prepare(rollout, pipeline)
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

    def encoding(self, pipeline: Pipeline) -> Pipeline:
        """Return a pipeline that stores what the encoder makes of observations, where it does not learn."""
        if self.config.train_encoder:
            return pipeline

        def store(observation: Observation) -> Observation:
            encoded: Observation = self.policy.encode(pipeline.prepare(as_read_back(observation)))
            return encoded

        return replace(pipeline, prepare=unchanged, store=store)

    def prepare(self, rollout: RolloutBuffer, pipeline: Pipeline) -> tuple[Minibatches, dict[str, float]]:
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
        """Add the reference's log-probabilities of the actions, and which actions of chunks were executed.
        Return the mean KL of the policy to the reference."""
        reference = torch.zeros_like(rollout.log_prob)  # (T, B, K) or (T, B, n, K)
        executed = rollout.executed()
        if executed is not None:
            rollout.columns[EXECUTED] = executed
        size = self.config.micro_batch_size or self.config.minibatch_size
        for rows in rollout.decided.flatten().nonzero()[:, 0].cpu().split(size):
            batch = read_batch(rollout, rows, pipeline)
            log_prob = self.reference.evaluate(batch["observation"], batch["raw_action"])[0]
            reference.flatten(0, 1)[rows.to(reference.device)] = log_prob
        rollout.columns[REFERENCE] = reference
        counted = torch.ones_like(rollout.log_prob[..., :1]) if executed is None else executed
        flat = [(each * counted).flatten(0, 1).flatten(1) for each in (rollout.log_prob, reference)]
        kl = kl_estimate(*flat) / steps_of(counted.flatten(0, 1))  # (T · B, K) each → (T · B,)
        return mean_and_variance(kl[rollout.decided.flatten()])[0].item()

    def update(self, batch_iterator: Iterator[Minibatch]) -> TrainingStats:
        """Take one optimiser step on each minibatch, until the KL to the rollout's policy exceeds
        `target_kl`. A step that is much too long is undone, and the next ones are shorter for a while."""
        records: list[dict[str, float]] = []
        first, within_target = self.optimization_step, False
        before: list[Tensor] = []  # the policy's parameters before the last step, if it was trained
        for minibatch in batch_iterator:
            self.optimizer.zero_grad()
            record = self.measure(minibatch)
            if self.taken_back(before, record["kl"]):
                break
            self.check_finite(record)
            records.append({**record, "policy_lr": self.policy_group["lr"]})
            if record["kl"] > self.config.target_kl:
                break
            if POLICY in self.trained_groups():
                before = [parameter.detach().clone() for parameter in self.policy_parameters]
            records[-1] |= self.optimizer_step()
        else:
            within_target = True
            if before:
                with torch.no_grad():
                    kl = self.measure(minibatch)["kl"]
                within_target = not self.taken_back(before, kl) and kl <= self.config.target_kl
        if within_target:
            self.policy_group["lr"] = min(self.config.policy_lr, LR_RECOVERY * self.policy_group["lr"])
        self.iteration += 1
        return training_stats(records, self.optimization_step - first)

    @property
    def policy_group(self) -> dict[str, Any]:
        """The optimiser's group of the policy, with its learning rate."""
        group: dict[str, Any] = self.optimizer.param_groups[list(self.parameter_groups()).index(POLICY)]
        return group

    @torch.no_grad()
    def taken_back(self, before: Sequence[Tensor], kl: float) -> bool:
        """Return whether the last step has moved the policy much too far, and if so take it back.

        The learning rate falls then, so that the next step comes to `target_kl`: the KL grows with the square
        of a step. A KL that has overflowed is too far as well.
        """
        if not before or kl <= UNDONE_KL * self.config.target_kl:
            return False
        for parameter, old in zip(self.policy_parameters, before, strict=True):
            parameter.copy_(old)
        factor = max(LEAST_LR_FACTOR, math.sqrt(self.config.target_kl / kl))  # the former for NaN too
        self.policy_group["lr"] *= factor
        logging.info(
            "iteration %d: one step has moved the policy by %.3g nats, and is undone; its learning rate is "
            "now %.2g", self.iteration + 1, kl, self.policy_group["lr"],
        )  # fmt: skip
        return True

    def measure(self, minibatch: Minibatch) -> dict[str, float]:
        """Return the metrics of a minibatch, and accumulate the gradient of its mean loss over micro-batches
        where gradients are computed."""
        parts: list[dict[str, Tensor]] = []
        for counted, batch in minibatch.micro_batches():
            loss, record = self.losses(batch)  # (B,), (B,) by name; rows from `counted` on do not count
            if torch.is_grad_enabled():
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
        # (B, n, 1). Not executed: ratio 1 and no gradient, but counted in the mean over ratios.
        executed = batch.get(EXECUTED, torch.ones_like(log_prob[..., :1]))
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
