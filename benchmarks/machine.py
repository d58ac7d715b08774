"""What this machine can do at best, and rates of pieces of work measured in turns."""

import time
from collections.abc import Callable, Mapping

import numpy as np
import torch

ROUNDS = 5
MATMULS = 5
STREAMED_BYTES = 2**28


def rates(works: Mapping[str, tuple[float, Callable[[], object]]], device: torch.device) -> dict[str, float]:
    """Units a second of each piece of work (units, call): the median of `ROUNDS` rounds, after one that does
    not count. In every round each piece has its turn: what else runs on the machine then slows all alike."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for measured in [False] + [True] * ROUNDS:
        for name, (_, work) in works.items():
            began = time.perf_counter()
            work()
            if device.type == "cuda":
                torch.cuda.synchronize()
            if measured:
                seconds[name].append(time.perf_counter() - began)
    return {name: units / float(np.median(seconds[name])) for name, (units, _) in works.items()}


def matmul_rate(dtype: torch.dtype, device: torch.device) -> float:
    """FLOP a second of large matrix products into memory that is there already."""
    side = 2048 if device.type == "cpu" else 8192
    a, b, out = (torch.ones(side, side, dtype=dtype, device=device) for _ in range(3))

    def multiply() -> None:
        for _ in range(MATMULS):
            torch.mm(a, b, out=out)

    return rates({"matmul": (MATMULS * 2 * side**3, multiply)}, device)["matmul"]


def stream_rate(device: torch.device) -> float:
    """Bytes a second of a copy from memory to memory, reading and writing counted."""
    source, target = (torch.ones(STREAMED_BYTES, dtype=torch.uint8, device=device) for _ in range(2))
    return rates({"copy": (2 * STREAMED_BYTES, lambda: target.copy_(source))}, device)["copy"]
