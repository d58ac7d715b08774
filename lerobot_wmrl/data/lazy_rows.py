"""Arrays beside a dataset whose rows are computed when they are first read, and then kept on disk."""

import errno
import fcntl
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import NOT_WRITABLE

PROGRESS_SECONDS: Final = 10
"""Seconds of work that are lost at most when a process is killed, beside one unit."""

NO_LOCKS: Final = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of disks whose files cannot be locked, as some that are shared over a network."""


class LazyRows:
    """A read-only array on disk whose rows are computed when they are first read.

    They are computed in units: the rows of an episode, or parts of a longer one. The file ends with a byte
    for each unit, which says whether it is there, so what was stopped goes on. Processes take turns to fill a
    file, also those of several machines, where the disk has locks.

    Args:
        path: the file, made if it is missing; it takes no room for rows that nobody has read.
        shape: rows, and the shape of each.
        dtype: of the values.
        starts: first row of each episode, (E,), from 0 on.
        compute: rows (K,), ascending, of whole units → their values (K, …).
        at_once: rows that are computed at once, at most.
        description: what the progress bar calls that.

    Raises:
        FieldError: the file cannot be made.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, ...],
        dtype: type,
        starts: np.ndarray,
        compute: Callable[[np.ndarray], np.ndarray],
        at_once: int,
        description: str,
    ) -> None:
        self.path, self.shape, self.dtype = path, shape, np.dtype(dtype)
        self._compute, self._at_once, self._description = compute, at_once, description
        bounds = zip(starts, [*starts[1:], shape[0]], strict=True)
        self._bounds = np.append(np.concatenate([np.arange(*each, at_once) for each in bounds]), shape[0])
        units = len(self._bounds) - 1
        self._unit = np.repeat(np.arange(units), np.diff(self._bounds))
        self._row_bytes = math.prod(shape[1:]) * self.dtype.itemsize
        values = shape[0] * self._row_bytes
        with room_in(path.parent):
            self._file = opened(path, values + units)
        mode: Any = "r+" if self._file.writable() else "r"
        self._values = np.memmap(self._file, self.dtype, mode, shape=shape)
        self._done = np.memmap(self._file, np.uint8, mode, offset=values, shape=(units,))
        self._shown = np.asarray(self._values).view()
        self._shown.flags.writeable = False

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        """Return rows by any index of numpy's, computed if they are missing."""
        self.fill(index[0] if isinstance(index, tuple) else index)
        rows: np.ndarray = self._shown[index]
        return rows

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return all rows as an array of numpy's."""
        return np.array(self[:], dtype=dtype, copy=copy)

    def fill(self, rows: Any) -> None:
        """Compute those of the rows that are missing, with the rest of their units.

        Raises:
            FieldError: the disk is full, or must not be written.
        """
        if self._done[self._unit[rows]].all():
            return
        with locked(self._file):
            units = np.unique(self._unit[rows])
            units = units[self._done[units] == 0]  # others may have done some in the meantime
            with room_in(self.path.parent):
                self._reserve(units)
            self._fill(units)

    def _fill(self, units: np.ndarray) -> None:
        sizes, recorded, unrecorded = np.diff(self._bounds)[units], time.monotonic(), list[int]()
        with tqdm(total=int(sizes.sum()), desc=self._description, unit="row", delay=1) as progress:
            try:
                for part in groups(sizes, self._at_once):
                    rows = np.concatenate([np.arange(*self._bounds[unit : unit + 2]) for unit in units[part]])
                    self._values[rows] = self._compute(rows)
                    unrecorded += units[part].tolist()
                    progress.update(len(rows))
                    if time.monotonic() - recorded > PROGRESS_SECONDS:
                        self._record(unrecorded)
                        recorded, unrecorded = time.monotonic(), []
            finally:
                self._record(unrecorded)

    def _record(self, units: list[int]) -> None:
        """Write to disk what was computed, before the file says that it is there."""
        if units:
            self._values.flush()
            self._done[units] = 1

    def _reserve(self, units: np.ndarray) -> None:
        """Reserve room for units: a full disk says so now, and not by a bus error later."""
        if not self._file.writable():
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        if not hasattr(os, "posix_fallocate"):
            return
        for run in np.split(units, np.flatnonzero(np.diff(units) > 1) + 1) if len(units) else ():
            begin, end = self._bounds[run[0]], self._bounds[run[-1] + 1]
            os.posix_fallocate(
                self._file.fileno(), int(begin) * self._row_bytes, int(end - begin) * self._row_bytes
            )


def opened(path: Path, size: int) -> FileIO:
    """Open a file for reading and, if it may be, writing. It is made if it is missing, as zeros that take no
    room; several processes may make it at once."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = FileIO(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+")
    except OSError:
        if not path.is_file() or path.stat().st_size != size:
            raise
        return FileIO(path)
    if os.fstat(file.fileno()).st_size < size:
        file.truncate(size)
    return file


def groups(sizes: np.ndarray, at_once: int) -> Iterator[slice]:
    """Divide units of these sizes (U,), in order, into groups of at most `at_once` rows."""
    begin = total = 0
    for number, size in enumerate(sizes.tolist()):
        if number > begin and total + size > at_once:
            yield slice(begin, number)
            begin, total = number, 0
        total += size
    if begin < len(sizes):
        yield slice(begin, len(sizes))


@contextmanager
def locked(file: FileIO) -> Iterator[None]:
    """Wait until no other process has the file, and keep others waiting; not on a disk without locks."""
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    try:
        yield
    finally:
        with suppress(OSError):
            fcntl.flock(file.fileno(), fcntl.LOCK_UN)


@contextmanager
def room_in(folder: Path) -> Iterator[None]:
    """Turn the error of a disk that is full or must not be written into one with a remedy."""
    try:
        yield
    except OSError as error:
        if error.errno not in NOT_WRITABLE:
            raise
        raise FieldError(
            "dataset.root",
            folder.with_suffix(""),
            f"its decoded frames are kept in {folder}, which cannot be written ({error})",
            "make room, or copy the dataset, or make a symbolic link to it, where you may write",
        ) from error
