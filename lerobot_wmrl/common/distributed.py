"""Several processes that train one model on shares of one batch: their losses are those of one process.

Each process has the rows `own_rows` of the whole batch. In one process everything here is the identity.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import timedelta

import torch
from torch import Tensor, nn
from torch import distributed as dist

LONGEST_WAIT = timedelta(hours=6)
"""Of other processes for the first one, while it encodes a large dataset, or measures a policy."""


def rank_and_size() -> tuple[int, int]:
    """This process's index and the number of processes; (0, 1) outside `torchrun`."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def own_rows(share: int) -> slice:
    """This process's rows of a batch of which every process has `share`."""
    rank, _ = rank_and_size()
    return slice(rank * share, (rank + 1) * share)


def draw_own_rows(draw: Callable[..., Tensor], shape: Sequence[int], device: torch.device) -> Tensor:
    """`draw(shape, device=…)` for the whole batch, of which (share, …) = `shape` is kept.

    The processes start from one seed and draw the same numbers, so that a row's noise does not depend on
    how many of them there are.
    """
    _, size = rank_and_size()
    return draw((size * shape[0], *shape[1:]), device=device)[own_rows(shape[0])]


def masked_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Σ values · weight / Σ weight, both of one shape → scalar; 0 where nothing counts.

    Processes divide by the mean of their Σ weight instead of by their own: the mean of what they return, and
    of its gradients (which DistributedDataParallel forms), is then the masked mean of the whole batch.
    """
    _, size = rank_and_size()
    total = weight.detach().sum().float()
    if size > 1:
        dist.all_reduce(total)
    return (values * weight).sum() / (total.clamp_min(1) / size)


def mean_over_processes(metrics: Mapping[str, float], device: torch.device | str) -> dict[str, float]:
    """Every process's metrics, of the same names, averaged. All processes must call it."""
    _, size = rank_and_size()
    if size == 1:
        return dict(metrics)
    values = torch.tensor(list(metrics.values()), dtype=torch.float32, device=device)
    dist.all_reduce(values)
    return dict(zip(metrics, (values / size).tolist(), strict=True))


def sum_over_processes(values: Tensor) -> Tensor:
    """Every process's `values`, of one shape, added up in place. All processes must call it."""
    if rank_and_size()[1] > 1:
        dist.all_reduce(values)
    return values


def largest_over_processes(values: Tensor) -> Tensor:
    """Return the largest of every process's `values`, in place. All processes must call it."""
    if rank_and_size()[1] > 1:
        dist.all_reduce(values, dist.ReduceOp.MAX)
    return values


def gather_counts(count: int, device: torch.device | str) -> list[int]:
    """Return every process's count, in the order of their ranks. All processes must call it."""
    rank, size = rank_and_size()
    counts = torch.zeros(size, dtype=torch.long, device=device)
    counts[rank] = count
    return sum_over_processes(counts).tolist()


def wait_for_all() -> None:
    """Until every process is here."""
    if rank_and_size()[1] > 1:
        dist.barrier()


def mean_and_variance(values: Tensor) -> tuple[Tensor, Tensor]:
    """Of every process's `values` (N,) together, N may differ. → (), () the variance of a sample, of one 0"""
    count = sum_over_processes(torch.tensor(float(len(values)), device=values.device))
    mean = sum_over_processes(values.sum()) / count
    return mean, sum_over_processes((values - mean).square().sum()) / (count - 1).clamp_min(1)


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace gradients by their means over all processes, in one message. The same parameters must have a
    gradient in all of them."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    _, size = rank_and_size()
    if size == 1 or not gradients:
        return
    mean = sum_over_processes(torch.cat([gradient.flatten() for gradient in gradients])) / size
    parts = mean.split([gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))
