"""Several processes that train one model on shares of one batch: their losses are those of one process.

Each process has the rows `own_rows` of the whole batch. In one process everything here is the identity.
"""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch import distributed as dist


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
