"""Files of caches: whole or absent, and continued where their writing was stopped."""

import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lerobot_wmrl.data.resumable_array import Units, memory_map


def counted(written: list[int], stop_at: int | None = None, by: type = KeyboardInterrupt) -> Units:
    """Return five units, each of which writes its number into two rows."""

    def write(target: np.ndarray, number: int) -> None:
        if number == stop_at:
            raise by
        written.append(number)
        target[2 * number : 2 * number + 2] = number

    return Units(5, write, "Counting")


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


def test_what_other_caches_left_is_removed_and_what_others_write_stays(tmp_path: Path) -> None:
    host = socket.gethostname()
    with subprocess.Popen(["sleep", "60"]) as other:
        gone = subprocess.run(
            [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True
        )
        torn = tmp_path / f"numbers-2.3.{host}+{gone.stdout.strip()}.partial"
        written_now = tmp_path / f"numbers-1.3.{host}+{other.pid}.partial"
        elsewhere = tmp_path / "numbers-1.3.another+1.partial"
        for file in (torn, written_now, elsewhere):
            file.write_bytes(b"")
        path = tmp_path / "numbers-1.npy"
        memory_map(path, (10,), np.int32, counted([]))
        assert {*tmp_path.iterdir()} == {path, written_now, elsewhere}
        other.kill()
