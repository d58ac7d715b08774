"""glibc's malloc, told to keep what tensors free instead of giving it back to the kernel.

A step of training allocates and frees the same tens of megabytes again and again; fetching them from the
kernel each time costs up to half of a small convolution's time on a CPU.
"""

import ctypes
import os
import platform
from typing import Final, NamedTuple


class Setting(NamedTuple):
    """A parameter's number in <malloc.h>, for mallopt(3), and its value."""

    number: int
    value: int


SETTINGS: Final = {
    "MALLOC_MMAP_MAX_": Setting(-4, 0),
    "MALLOC_TRIM_THRESHOLD_": Setting(-1, (2 << 30) - 1),
    "MALLOC_TOP_PAD_": Setting(-2, 256 << 20),
}
"""By the environment variables that set them in a process that is yet to start."""


def keep_freed_memory() -> None:
    """In this process and those it starts. What the environment already says wins; no-op without glibc."""
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    for name, setting in SETTINGS.items():
        if name not in os.environ:
            libc.mallopt(setting.number, setting.value)
            os.environ[name] = str(setting.value)
