"""Minibatches of a rollout, shared by processes and cut into passes that fit into memory.

T time, B environments of each process. A step is known by its flat row, step * B + environment.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.common.distributed import joined_columns, of_first_process, rank_and_size
from lerobot_wmrl.rl.protocol import Pipeline
from lerobot_wmrl.rl.rollout import RolloutBuffer

Steps = dict[str, Any]
"""Of B steps: `observation`, `raw_action`, `log_prob`, `weight` (1, or 0 for a step that only fills in) and
what else the updates need."""


class Minibatch(NamedTuple):
    """`size` steps in all processes together, this one's share in `passes`."""

    size: int
    passes: Iterator[Steps]


def make_minibatches(
    buffer: RolloutBuffer, chosen: Tensor, pipeline: Pipeline, size: int, pass_size: int | None, epochs: int
) -> Iterator[Minibatch]:
    """Every step of `chosen` (T, B) once an epoch, in random order, `size` at a time."""
    for total, shares in own_shares(chosen, size, pass_size, epochs):
        yield Minibatch(total, (read_steps(buffer, rows, pipeline) for rows in shares))


def own_shares(
    chosen: Tensor, size: int, pass_size: int | None, epochs: int
) -> Iterator[tuple[int, tuple[Tensor, ...]]]:
    """Sizes of minibatches, and of each this process's rows, in as many parts as every other process has:
    then large models may be sharded, whose passes need all processes. (T, B) bool"""
    rank, processes = rank_and_size()
    num_envs = chosen.shape[1]
    everywhere = joined_columns(chosen)
    rows = everywhere.flatten().nonzero()[:, 0].cpu()
    for _ in range(epochs if len(rows) else 0):
        order = of_first_process(torch.randperm(len(rows)).to(chosen.device)).cpu()
        for part in rows[order].split(size):
            step, column = part // everywhere.shape[1], part % everywhere.shape[1]
            owner, env = column // num_envs, column % num_envs
            most = int(owner.bincount(minlength=processes).max())
            passes = -(-most // (pass_size or most))
            yield len(part), (step * num_envs + env)[owner == rank].tensor_split(passes)


def read_steps(buffer: RolloutBuffer, rows: Tensor, pipeline: Pipeline) -> Steps:
    """The steps of flat rows, in the CPU's memory. Without any, one that does not count: so all processes
    have gradients."""
    weight = torch.ones(len(rows), device=buffer.device)
    if not len(rows):
        rows, weight = rows.new_zeros(1), weight.new_zeros(1)
    moved = rows.to(buffer.device)
    stored = {"raw_action": buffer.raw_action, "log_prob": buffer.log_prob, **buffer.columns}
    taken = {name: values.flatten(0, 1)[moved] for name, values in stored.items()}
    return {"observation": pipeline.prepare(buffer.observations.read(rows)), "weight": weight, **taken}
