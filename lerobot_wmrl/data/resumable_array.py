"""Memory-mapped arrays beside a dataset, which go on where their writing was stopped."""

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import psutil
from tqdm import trange

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import NOT_WRITABLE

BATCH: Final = 128
"""Rows that are computed at once."""

PROGRESS_SECONDS: Final = 10
"""Seconds of work on a cache that are lost at most when a process is killed."""


class Units(NamedTuple):
    """What a cache is written in, one after another: `total` of them, `write(target, number)`, and the
    progress bar's description."""

    total: int
    write: Callable[[np.ndarray, int], None]
    description: str


def batches(rows: int, compute: Callable[[slice], np.ndarray], description: str) -> Units:
    """Return units of `BATCH` rows, each of which is what `compute` returns for it."""

    def write(target: np.ndarray, number: int) -> None:
        part = slice(number * BATCH, (number + 1) * BATCH)
        target[part] = compute(part)

    return Units(-(-rows // BATCH), write, description)


def memory_map(path: Path, shape: tuple[int, ...], dtype: type, units: Units) -> np.ndarray:
    """Return the array at `path`, written if it is missing. The file appears only once it is whole.

    A call that was interrupted or killed is continued: the name of its file says how many units are in it.
    One that failed leaves nothing.
    """
    if not path.is_file():
        with room_in(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            partial, begun = begin_or_continue(path, shape, dtype)
        target = np.lib.format.open_memmap(partial, mode="r+")
        recorded, done = time.monotonic(), begun
        try:
            for number in trange(
                begun, units.total, desc=units.description, initial=begun, total=units.total
            ):
                units.write(target, number)
                done = number + 1
                if time.monotonic() - recorded > PROGRESS_SECONDS:
                    partial, recorded = record_progress(partial, path, target, done), time.monotonic()
            target.flush()
            partial.replace(path)
        except KeyboardInterrupt:
            record_progress(partial, path, target, done)
            raise
        except Exception:  # of a broken file, say, in whose place there will be another one
            partial.unlink(missing_ok=True)
            raise
    return np.load(path, mmap_mode="r")


def begin_or_continue(path: Path, shape: tuple[int, ...], dtype: type) -> tuple[Path, int]:
    """Return the file that becomes the cache at `path`, and how many units are in it already.

    Files of processes that are gone are taken over, or removed where they belong to another cache.
    """
    host = socket.gethostname()  # others may share the folder, and their processes are not seen here
    for torn in path.parent.glob(f"*.{host}+*.partial"):
        process = int(torn.stem.rpartition("+")[2])
        if process != os.getpid() and psutil.pid_exists(process):
            continue
        count = torn.name.removeprefix(f"{path.stem}.").partition(".")[0]
        with suppress(FileNotFoundError):  # another process was faster
            if count.isdecimal() and int(count):
                return torn.rename(partial_path(path, int(count))), int(count)
            torn.unlink()
    partial = partial_path(path, 0)
    try:
        np.lib.format.open_memmap(partial, mode="w+", dtype=dtype, shape=shape)
        with partial.open("r+b") as file:  # a full disk says so now, and not by a bus error later
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, partial.stat().st_size)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    return partial, 0


def record_progress(partial: Path, path: Path, target: np.memmap, done: int) -> Path:
    """Write what is in memory to the unfinished file, and let its name say how many units are in it."""
    target.flush()
    return partial.rename(partial_path(path, done))


def partial_path(path: Path, done: int) -> Path:
    """Return where this process writes the cache at `path` while so many units are done."""
    return path.with_name(f"{path.stem}.{done}.{socket.gethostname()}+{os.getpid()}.partial")


@contextmanager
def room_in(folder: Path) -> Iterator[None]:
    """Turn the error of a disk that is full or must not be written into one with a remedy."""
    try:
        yield
    except OSError as error:
        if error.errno not in NOT_WRITABLE:
            raise
        raise FieldError(
            "dataset.root", folder.with_suffix(""),
            f"its decoded frames are kept in {folder}, which cannot be written ({error})",
            "make room, or copy the dataset, or make a symbolic link to it, where you may write",
        ) from error  # fmt: skip
