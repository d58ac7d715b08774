"""Memory-mapped arrays beside a dataset, which go on where their writing was stopped."""

import errno
import fcntl
import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from tqdm import trange

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import NOT_WRITABLE

BATCH: Final = 128
"""Rows that are computed at once."""

NO_LOCKS: Final = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of disks whose files cannot be locked, as some that are shared over a network."""

PROGRESS_SECONDS: Final = 10
"""Seconds of work on a cache that are lost at most when a process is killed."""


class WritePlan(NamedTuple):
    """How a cache is written: in `total` units, one after another by `write(target, number)`, and what the
    progress bar calls that."""

    total: int
    write: Callable[[np.ndarray, int], None]
    description: str


def batches(rows: int, compute: Callable[[slice], np.ndarray], description: str) -> WritePlan:
    """Plan units of `BATCH` rows, each of which is what `compute` returns for it."""

    def write(target: np.ndarray, number: int) -> None:
        part = slice(number * BATCH, (number + 1) * BATCH)
        target[part] = compute(part)

    return WritePlan(-(-rows // BATCH), write, description)


def memory_map(path: Path, shape: tuple[int, ...], dtype: type, plan: WritePlan) -> np.ndarray:
    """Return the array at `path`, written if it is missing. The file appears only once it is whole.

    A call that was interrupted or killed is continued, wherever it ran: the name of its file says how many
    units are in it. One that failed leaves nothing.
    """
    if not path.is_file():
        with room_in(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            partial, begun, lock = continued(path) or begin(path, shape, dtype)
        target = np.lib.format.open_memmap(partial, mode="r+")
        recorded, done = time.monotonic(), begun
        try:
            for number in trange(begun, plan.total, desc=plan.description, initial=begun, total=plan.total):
                plan.write(target, number)
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
        finally:
            os.close(lock)
    return np.load(path, mmap_mode="r")


def continued(path: Path) -> tuple[Path, int, int] | None:
    """Return the unfinished file of the cache at `path` that nobody writes any more, how many units are in it
    already, and the descriptor that holds its lock; None if there is none.

    Such files of other caches are removed: they belong to content that has changed.
    """
    for torn in path.parent.glob("[!.]*.partial"):
        if (lock := try_lock(torn)) is None:
            continue
        count = torn.name.removeprefix(f"{path.stem}.").partition(".")[0]
        if count.isdecimal() and int(count):
            return torn, int(count), lock
        torn.unlink()
        os.close(lock)
    return None


def begin(path: Path, shape: tuple[int, ...], dtype: type) -> tuple[Path, int, int]:
    """Return a new file that becomes the cache at `path`, 0, and the descriptor that holds its lock."""
    partial = path.with_name(f"{path.stem}.0.{secrets.token_hex(4)}.partial")
    try:
        np.lib.format.open_memmap(partial, mode="w+", dtype=dtype, shape=shape)
        with partial.open("r+b") as file:  # a full disk says so now, and not by a bus error later
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, partial.stat().st_size)
        lock = try_lock(partial, own=True)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    # another process may have begun in between, and taken it for a torn one
    return begin(path, shape, dtype) if lock is None else (partial, 0, lock)


def try_lock(file: Path, own: bool = False) -> int | None:
    """Return a descriptor that holds a file's lock until it is closed, or its process ends.

    Returns:
        None where another process holds it, on this machine or on another that shares the folder, or has
        removed the file. For what is a process's `own` a lock is waited for, and done without on a disk that
        has none, where nothing can be continued.
    """
    try:
        descriptor = os.open(file, os.O_RDWR)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if own else fcntl.LOCK_NB))
        if os.path.samestat(os.fstat(descriptor), file.stat()):
            return descriptor
    except (BlockingIOError, FileNotFoundError):
        pass
    except OSError as error:
        if own and error.errno in NO_LOCKS:
            return descriptor
    os.close(descriptor)
    return None


def record_progress(partial: Path, path: Path, target: np.memmap, done: int) -> Path:
    """Write what is in memory to the unfinished file, and let its name say how many units are in it."""
    target.flush()
    own = partial.name.removesuffix(".partial").rpartition(".")[2]
    return partial.rename(path.with_name(f"{path.stem}.{done}.{own}.partial"))


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
