"""Runs one command: shows and logs its output, measures its time and memory, ends its whole group."""

import ctypes
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

import psutil

SAMPLE_SECONDS = 1.0
"""How often memory is sampled and progress is reported."""

MALLOC = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(16 << 30), "MALLOC_TOP_PAD_": str(256 << 20)}
"""glibc keeps freed tensors instead of giving them back to the kernel: 1.1-1.5 times faster on a CPU."""

Report = Callable[[float, int], None]
"""Called about once a second with the seconds since the start and the peak memory so far in bytes."""


def environment() -> dict[str, str]:
    """What a command of the demo gets: no network (everything is local), unbuffered output, fast malloc."""
    columns = str(shutil.get_terminal_size().columns)
    return {"HF_HUB_OFFLINE": "1", "PYTHONUNBUFFERED": "1", "COLUMNS": columns, **MALLOC, **os.environ}


def run_measured(command: Sequence[str], log: Path, report: Report) -> int:
    """Run `command` to its end and return its exit status; an exception ends its process group first."""
    process = subprocess.Popen(
        command,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        preexec_fn=_die_with_parent,
    )
    try:
        with log.open("ab") as file:
            _follow(process, file, report)
        return process.wait()
    finally:
        _end_group(process)


def _follow(process: subprocess.Popen[bytes], log: BinaryIO, report: Report) -> None:
    assert process.stdout is not None
    start, peak, sampled = time.monotonic(), 0, float("-inf")
    while True:
        finished = process.poll() is not None
        readable, _, _ = select.select([process.stdout], [], [], 0.0 if finished else 0.2)
        chunk = os.read(process.stdout.fileno(), 1 << 16) if readable else b""
        _tee(chunk, log)
        if finished and not chunk:
            report(time.monotonic() - start, peak)
            return
        if time.monotonic() - sampled >= SAMPLE_SECONDS:
            sampled = time.monotonic()
            peak = max(peak, tree_memory(process.pid))
            report(sampled - start, peak)


def _tee(chunk: bytes, log: BinaryIO) -> None:
    if chunk:
        log.write(chunk)
        log.flush()
        sys.stdout.buffer.write(chunk)
        sys.stdout.flush()


def tree_memory(pid: int) -> int:
    """Resident bytes of a process and its descendants: an upper bound, for shared pages count once each."""
    total = 0
    try:
        root = psutil.Process(pid)
        processes = [root, *root.children(recursive=True)]
    except psutil.NoSuchProcess:
        return 0
    for process in processes:
        try:
            total += process.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """Interrupt what is left of the group, politely first. Nothing to do after a normal end."""
    for sign, seconds in ((signal.SIGINT, 10.0), (signal.SIGKILL, 5.0)):
        try:
            os.killpg(process.pid, sign)
            process.wait(seconds)
        except ProcessLookupError:
            break
        except subprocess.TimeoutExpired:
            continue
    if process.stdout is not None:
        process.stdout.close()


def _die_with_parent() -> None:
    """In the child: be killed when the demo is, else a second call meets two writers in a folder (Linux)."""
    set_parent_death_signal = 1
    ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
