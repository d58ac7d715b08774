"""Rows on disk are computed when they are read, once, and go on where that was stopped."""

import errno
import fcntl
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lerobot_wmrl.data import lazy_rows
from lerobot_wmrl.data.lazy_rows import LazyRows, groups, opened

STARTS = np.array([0, 2, 3, 6])
"""Of episodes of two, one, three and four rows."""

Compute = Callable[[np.ndarray], np.ndarray]


def rows_at(
    path: Path, computed: list[int], stop_at: int = -1, by: type = KeyboardInterrupt, at_once: int = 4
) -> LazyRows:
    """Return ten rows, each its number twice, that note which of them were computed."""

    def numbers(rows: np.ndarray) -> np.ndarray:
        if stop_at in rows:
            raise by
        computed.extend(rows.tolist())
        return np.stack([rows, rows], 1)

    return LazyRows(path, (10, 2), np.int32, STARTS, numbers, at_once, "Counting")


class Killed(BaseException):
    """Ends the process as a kill does: nothing is tidied up."""

    def __init__(self) -> None:
        os._exit(9)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.cache" / "numbers-1.rows"


@pytest.mark.parametrize(
    ("index", "units"),
    [
        (4, [3, 4, 5]),
        (slice(1, 3), [0, 1, 2]),
        (np.array([[0, 9], [9, 1]]), [0, 1, 6, 7, 8, 9]),
        ((2, 1), [2]),
        (np.arange(10) == 2, [2]),
        (slice(0, 0), []),
    ],
)
def test_what_is_read_is_computed_with_its_unit_and_once(path: Path, index: object, units: list[int]) -> None:
    computed: list[int] = []
    rows, every = rows_at(path, computed), np.repeat(np.arange(10)[:, None], 2, 1)
    np.testing.assert_array_equal(rows[index], every[index])
    assert computed == units
    rows[index]
    rows_at(path, computed)[index]
    assert computed == units, "also by another process, later"
    np.testing.assert_array_equal(rows, every)
    assert sorted(computed) == list(range(10))


def test_a_long_episode_is_computed_in_parts(path: Path) -> None:
    computed: list[int] = []
    assert rows_at(path, computed, at_once=3)[7, 0] == 7
    assert computed == [6, 7, 8]


@pytest.mark.parametrize("by", [KeyboardInterrupt, ValueError])
@pytest.mark.parametrize(("at_once", "done"), [(4, 3), (2, 5)])
def test_what_was_stopped_goes_on(path: Path, by: type, at_once: int, done: int) -> None:
    """Several episodes are computed at once, or parts of a longer one."""
    computed: list[int] = []
    with pytest.raises(by):
        rows_at(path, computed, stop_at=5, by=by, at_once=at_once)[:]
    assert computed == list(range(done))
    again: list[int] = []
    assert rows_at(path, again, at_once=at_once)[:, 0].tolist() == list(range(10))
    assert again == list(range(done, 10))


def test_a_killed_process_loses_seconds(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it has computed is on disk, and noted there."""
    monkeypatch.setattr(lazy_rows, "PROGRESS_SECONDS", 0)
    if not (child := os.fork()):
        rows_at(path, [], stop_at=6, by=Killed)[:]
        sys.exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    again: list[int] = []
    rows_at(path, again)[:]
    assert again == [6, 7, 8, 9]


def test_processes_fill_one_file(path: Path) -> None:
    """Each sees what the other has computed. One may open the file when the other has just made it."""
    path.parent.mkdir()
    path.touch()
    ours: list[int] = []
    theirs: list[int] = []
    first, second = rows_at(path, ours), rows_at(path, theirs)
    first[0], second[3], first[4], second[1]
    assert (ours, theirs) == ([0, 1], [3, 4, 5])
    np.testing.assert_array_equal(first, second)


def test_short_episodes_are_computed_several_at_once() -> None:
    assert [*groups(np.array([2, 1, 3, 4, 1]), 4)] == [slice(0, 2), slice(2, 3), slice(3, 4), slice(4, 5)]
    assert [*groups(np.array([], int), 4)] == []


def test_a_file_is_as_long_as_it_becomes_at_once(tmp_path: Path) -> None:
    """Numpy would lengthen it by a zero at its end, over what another process may have written there."""
    opened(tmp_path / "new" / "rows", 100).close()
    assert (tmp_path / "new" / "rows").stat().st_size == 100


def test_they_take_turns_where_the_disk_has_locks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the other process has computed in the meantime is not computed again."""
    computed: list[int] = []
    rows, other = rows_at(path, computed), rows_at(path, [])
    fcntl.flock(other._file.fileno(), fcntl.LOCK_EX)
    reader = threading.Thread(target=lambda: rows[0:4])
    reader.start()
    other._fill(np.array([0, 1]))
    reader.join(0.2)
    assert computed == []
    fcntl.flock(other._file.fileno(), fcntl.LOCK_UN)
    reader.join()
    assert computed == [3, 4, 5]

    def refused(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr("fcntl.flock", refused)
    assert rows[9, 0] == 9


def test_nobody_writes_into_what_is_read(path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        rows_at(path, [])[0:2][0] = 7


def test_a_full_disk_is_said_before_anything_is_computed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, offset: int, size: int) -> None:
        assert (offset, size) == (3 * 8, 3 * 8), "room for the rows of the unit"
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    computed: list[int] = []
    with pytest.raises(ValueError, match=r"^dataset\.root=.*data: .* cannot be written .*No space.*; make"):
        rows_at(path, computed)[4]
    assert computed == []
    assert path.stat().st_blocks * 512 <= 8192, "rows that nobody has read take no room"


def test_a_cache_that_must_not_be_written_is_read(path: Path) -> None:
    rows_at(path, [])[:]
    path.chmod(0o400)
    assert rows_at(path, computed := [])[9, 0] == 9
    assert computed == []
