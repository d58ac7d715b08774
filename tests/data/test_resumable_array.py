"""Files of caches: whole or absent, and continued where their writing was stopped."""

import errno
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lerobot_wmrl.data.resumable_array import WritePlan, memory_map


def counted(written: list[int], stop_at: int | None = None, by: type = KeyboardInterrupt) -> WritePlan:
    """Return five units, each of which writes its number into two rows."""

    def write(target: np.ndarray, number: int) -> None:
        if number == stop_at:
            raise by
        written.append(number)
        target[2 * number : 2 * number + 2] = number

    return WritePlan(5, write, "Counting")


def test_a_cache_whose_writing_was_stopped_goes_on(tmp_path: Path) -> None:
    path, written = tmp_path / "cache" / "numbers-1.npy", []
    arguments = (path, (10,), np.int32)
    with pytest.raises(RuntimeError):
        memory_map(*arguments, counted([], stop_at=3, by=RuntimeError))
    assert not [*path.parent.iterdir()], "an error leaves nothing"
    with pytest.raises(KeyboardInterrupt):
        memory_map(*arguments, counted(written, stop_at=3))
    (torn,) = path.parent.iterdir()
    assert torn.name.startswith("numbers-1.3.")
    assert memory_map(*arguments, counted(written)).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert written == [0, 1, 2, 3, 4]
    assert [*path.parent.iterdir()] == [path]


HOLD = """
import fcntl, os, sys
fcntl.flock(os.open(sys.argv[1], os.O_RDWR), fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


def test_what_is_torn_goes_on_or_is_removed_and_what_others_write_stays(tmp_path: Path) -> None:
    """Whatever the process was that wrote it: a container's has the same number again, and another host."""
    path, written = tmp_path / "numbers-1.npy", []
    with pytest.raises(KeyboardInterrupt):
        memory_map(path, (10,), np.int32, counted([], stop_at=3))
    (torn,) = tmp_path.iterdir()
    written_now = torn.with_name(torn.name.replace(".3.", ".2.own"))
    shutil.copy(torn, written_now)
    elsewhere = torn.rename(tmp_path / "numbers-1.3.another-host+1.partial")
    other = tmp_path / "numbers-2.3.another-host+1.partial"
    other.write_bytes(b"")
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(written_now)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout
        holder.stdout.readline()
        assert memory_map(path, (10,), np.int32, counted(written)).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
        assert {*tmp_path.iterdir()} - {other} == {path, written_now}
        assert not elsewhere.exists()
        path.unlink()
        again: list[int] = []
        memory_map(path, (10,), np.int32, counted(again))
    assert written == [3, 4]
    assert again == [0, 1, 2, 3, 4], "what is written now is not taken over"
    assert {*tmp_path.iterdir()} == {path, written_now}
    path.unlink()
    memory_map(path, (10,), np.int32, counted(left := []))
    assert left == [2, 3, 4], "its process has ended"
    assert [*tmp_path.iterdir()] == [path]


def test_where_files_have_no_locks_a_cache_is_written_and_nothing_taken_over(tmp_path, monkeypatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr("fcntl.flock", refused)
    torn = tmp_path / "numbers-1.3.another.partial"
    torn.write_bytes(b"")
    memory_map(tmp_path / "numbers-1.npy", (10,), np.int32, counted(written := []))
    assert written == [0, 1, 2, 3, 4]
    assert torn.exists()
