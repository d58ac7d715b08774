"""Arrays beside a dataset whose rows are computed when they are first read, and then kept on disk."""

import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import NOT_WRITABLE

BATCH: Final = 128
"""Rows that are computed at once."""

PROGRESS_SECONDS: Final = 10
"""Seconds of work that are lost at most when a process is killed."""


class LazyRows:
    """A read-only array on disk whose rows are computed when they are first read.

    Rows belong to units, such as the frames of an episode, which are computed whole. The file ends with a
    byte for each unit, which says whether it is there, so what was stopped goes on. Processes may fill one
    file at once: at worst one computes again what another has just done, with the same values.

    Args:
        path: the file, made if it is missing.
        shape: rows, and the shape of each.
        dtype: of the values.
        first: first row of each unit, (U,), from 0 on.
        compute: rows (K,), ascending → their values (K, …).
        description: what the progress bar calls that.

    Raises:
        FieldError: the file cannot be made or grow.
    """

    def __init__(
        self, path: Path, shape: tuple[int, ...], dtype: type, first: np.ndarray,
        compute: Callable[[np.ndarray], np.ndarray], description: str,
    ) -> None:  # fmt: skip
        self.path, self.shape, self.dtype = path, shape, np.dtype(dtype)
        self._compute, self._description = compute, description
        self._bounds = np.append(first, shape[0])
        self._unit = np.repeat(np.arange(len(first)), np.diff(self._bounds))
        self._row_bytes = int(np.prod(shape[1:])) * self.dtype.itemsize
        values = shape[0] * self._row_bytes
        with room_in(path.parent):
            if not path.is_file():
                make_sparse(path, values + len(first))
        mode: Any = "r+" if os.access(path, os.W_OK) else "r"
        self._values = np.memmap(path, self.dtype, mode, shape=shape)
        self._done = np.memmap(path, np.uint8, mode, offset=values, shape=(len(first),))
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
        wanted = self._unit[rows]
        if self._done[wanted].all():
            return
        units = np.unique(wanted)
        units = units[self._done[units] == 0]
        missing = np.concatenate([np.arange(*self._bounds[unit : unit + 2]) for unit in units])
        ends = np.cumsum(np.diff(self._bounds)[units])
        with room_in(self.path.parent):
            self._reserve(missing)
        recorded, computed = time.monotonic(), 0
        with tqdm(
            total=len(missing), desc=self._description, unit="row", disable=len(missing) <= BATCH
        ) as progress:
            try:
                for begin in range(0, len(missing), BATCH):
                    part = missing[begin : begin + BATCH]
                    self._values[part] = self._compute(part)
                    computed = begin + len(part)
                    progress.update(len(part))
                    if time.monotonic() - recorded > PROGRESS_SECONDS:
                        self._record(units[ends <= computed])
                        recorded = time.monotonic()
            finally:
                self._record(units[ends <= computed])

    def _record(self, units: np.ndarray) -> None:
        """Write to disk what was computed, then that it is there."""
        self._values.flush()
        self._done[units] = 1
        self._done.flush()

    def _reserve(self, rows: np.ndarray) -> None:
        """Reserve room for rows: a full disk says so now, and not by a bus error later."""
        if not hasattr(os, "posix_fallocate"):
            return
        runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        with self.path.open("r+b") as file:
            for run in runs if self._row_bytes else ():
                os.posix_fallocate(file.fileno(), int(run[0]) * self._row_bytes, len(run) * self._row_bytes)


def make_sparse(path: Path, size: int) -> None:
    """Make a file of zeros that takes no room yet. It appears whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    made = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with made.open("wb") as file:
            file.truncate(size)
        made.replace(path)
    finally:
        made.unlink(missing_ok=True)


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
