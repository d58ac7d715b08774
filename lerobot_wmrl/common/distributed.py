"""Several processes that train one model. In one process everything here is the identity."""

from collections.abc import Iterable, Mapping
from datetime import timedelta

import torch
from lerobot.utils.random_utils import set_seed
from torch import Tensor, nn
from torch import distributed as dist

LONGEST_WAIT = timedelta(hours=6)
"""Time that the other processes wait while the first one encodes a large dataset or measures a policy."""


PROCESS_STRIDE = 1_000_003
"""Distance between the seeds of processes that train together."""


def rank_and_size() -> tuple[int, int]:
    """Return this process's index and the number of processes; (0, 1) outside `torchrun`."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def process_seed(seed: int) -> int:
    """Return the seed of this process in a run of this seed: far from those of runs with other seeds."""
    rank, _ = rank_and_size()
    return seed + PROCESS_STRIDE * rank


def reseed_other_ranks(seed: int) -> None:
    """Give every process but the first, which goes on as it would alone, random numbers of its own."""
    if not is_first_process():
        set_seed(process_seed(seed))


def broadcast_buffers(module: nn.Module) -> None:
    """Replace a module's buffers, which no gradient keeps alike, by those of the first process."""
    if rank_and_size()[1] > 1:
        for buffer in module.buffers():
            dist.broadcast(buffer, 0)


def hidden_progress() -> bool | None:
    """Return tqdm's `disable`: in the first process None, which shows a bar in a terminal only; else True."""
    return None if is_first_process() else True


def mean_over_processes(metrics: Mapping[str, float], device: torch.device | str) -> dict[str, float]:
    """Return the mean of every process's metrics, which have the same names. All processes must call it."""
    _, size = rank_and_size()
    if size == 1:
        return dict(metrics)
    values = torch.tensor(list(metrics.values()), dtype=torch.float32, device=device)
    dist.all_reduce(values)
    return dict(zip(metrics, (values / size).tolist(), strict=True))


def sum_over_processes(values: Tensor) -> Tensor:
    """Add up every process's `values`, of one shape, in place. All processes must call it."""
    if rank_and_size()[1] > 1:
        dist.all_reduce(values)
    return values


def largest_over_processes(values: Tensor) -> Tensor:
    """Return the largest of every process's `values`, in place. All processes must call it."""
    if rank_and_size()[1] > 1:
        dist.all_reduce(values, dist.ReduceOp.MAX)
    return values


def is_first_process() -> bool:
    """Return whether this process is the one that writes and shows progress."""
    return rank_and_size()[0] == 0


def gather_counts(count: int, device: torch.device | str) -> list[int]:
    """Return every process's count, in the order of their ranks. All processes must call it."""
    rank, size = rank_and_size()
    counts = torch.zeros(size, dtype=torch.long, device=device)
    counts[rank] = count
    return sum_over_processes(counts).tolist()


def wait_for_all() -> None:
    """Wait until every process is here."""
    if rank_and_size()[1] > 1:
        dist.barrier()


def mean_and_variance(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean () and sample variance () of all processes' `values` (N,); their N may differ."""
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
