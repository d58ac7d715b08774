"""Minibatches of a rollout's decisions. B decisions, N rows.

In several processes each one cuts minibatches from its own rollout.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.common.distributed import gather_counts
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig
from lerobot_wmrl.rl.rollout import RolloutBuffer

Batch = dict[str, Any]
"""B decisions: `observation`, `raw_action`, `log_prob` and the buffer's columns."""


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
