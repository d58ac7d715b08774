"""Device, number format and memory: bfloat16 where the hardware multiplies in it, else float32; malloc.

Weights, losses and optimiser states stay in float32; autocast chooses by operation (mixed precision,
Micikevicius et al. 2018; bfloat16 needs no scaling of the loss).
"""

import ctypes
import os
import platform
from collections.abc import Iterable
from typing import Final, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError

SMALL_BATCH: Final = 16
"""In so few imaginations at once on the CPU, casts cost more than bfloat16 saves."""

PRECISIONS: Final = ("auto", "float32", "bfloat16")


def multiplies_bfloat16(device: torch.device | str) -> bool:
    """Return whether `device` has instructions for bfloat16: CUDA from Ampere on; AVX512-BF16 or AMX."""
    kind = torch.device(device).type
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return kind == "cpu" and (torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def imagination_dtype(device: torch.device | str, batch: int = SMALL_BATCH) -> torch.dtype:
    """Return the fastest format on `device` that is exact enough for `batch` imaginations at once."""
    small = batch < SMALL_BATCH and torch.device(device).type == "cpu"
    return torch.bfloat16 if multiplies_bfloat16(device) and not small else torch.float32


def training_dtype(precision: str, device: torch.device | str) -> torch.dtype:
    """Return the format that `precision` means on `device`. FieldError if it is none of `PRECISIONS`."""
    if precision not in PRECISIONS:
        raise FieldError("precision", precision, f"choose one of {', '.join(PRECISIONS)}")
    if precision == "auto":
        return torch.bfloat16 if multiplies_bfloat16(device) else torch.float32
    return torch.float32 if precision == "float32" else torch.bfloat16


def require_exact_updates(trained: Iterable[Tensor]) -> None:
    """Raise FieldError if trained weights are in bfloat16, whose eight bits round small steps away."""
    if any(weights.dtype == torch.bfloat16 for weights in trained):
        raise FieldError(
            "policy.dtype",
            "bfloat16",
            "such weights cannot be trained: most steps would be rounded away",
            "use `policy.dtype=float32`, or train adapters, `peft.method_type=LORA`",
        )


def compute_in(dtype: torch.dtype, device: torch.device | str) -> torch.autocast:
    """Return a context in which matrix products and convolutions run in `dtype`; float32 switches a
    surrounding autocast off."""
    return torch.autocast(torch.device(device).type, dtype=dtype, enabled=dtype != torch.float32)


def device_setting(device: torch.device) -> str:
    """Return a device as LeRobot's settings take it: with a number for CUDA alone (not `mps:0`)."""
    return str(device) if device.type == "cuda" else device.type


def computing_dtype(device: torch.device | str) -> torch.dtype:
    """Return the format of the surrounding `compute_in` on `device`; float32 outside of one."""
    kind = torch.device(device).type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else torch.float32


class MallocSetting(NamedTuple):
    """A parameter of glibc's malloc: its number for mallopt(3), and its value."""

    number: int
    value: int


MALLOC_SETTINGS: Final = {
    "MALLOC_MMAP_MAX_": MallocSetting(-4, 0),
    "MALLOC_TRIM_THRESHOLD_": MallocSetting(-1, (2 << 30) - 1),
    "MALLOC_TOP_PAD_": MallocSetting(-2, 256 << 20),
}
"""Environment variable, which sets it in a process that is yet to start → parameter."""


def keep_freed_memory() -> None:
    """Tell malloc, here and in processes started from here, to keep what tensors free.

    A step of training allocates and frees the same tens of megabytes again and again; fetching them from the
    kernel each time costs up to half of a small convolution's time on a CPU. What the environment already
    says wins. Without glibc nothing happens.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    for name, setting in MALLOC_SETTINGS.items():
        if name not in os.environ:
            libc.mallopt(setting.number, setting.value)
            os.environ[name] = str(setting.value)
