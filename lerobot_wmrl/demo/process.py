"""Runs one command in a forked process: shows and logs its output, measures it, ends its whole group.

Forking from a process that has imported the libraries saves every stage the ten seconds they take to import.
"""

import importlib
import importlib.metadata
import logging
import multiprocessing
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import BinaryIO

import psutil

from lerobot_wmrl.common.die_with_parent import die_with
from lerobot_wmrl.common.malloc import keep_freed_memory
from lerobot_wmrl.common.progress import own_progress_lock

SAMPLE_SECONDS = 1.0
"""How often memory is sampled and progress is reported."""

PRELOADED = (
    "lerobot.scripts.lerobot_train",
    "lerobot.scripts.lerobot_eval",
    "lerobot_env_wmrl",
    "lerobot_wmrl.maniskill.simulation",
)

Report = Callable[[float, int], None]
"""Called about once a second with the seconds since the start and the peak memory so far in bytes."""


def preload() -> None:
    """Import what every stage needs, once, and spare the reader a page about FFmpeg from each of them.

    No stage needs the network; the libraries ask whether they may use it when they are imported.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    for module in PRELOADED:
        importlib.import_module(module)


def entry_point(program: str) -> Callable[[], int | None]:
    """The function that the console command `program` calls. ValueError if no package installs it."""
    found = importlib.metadata.entry_points(group="console_scripts", name=program)
    if not found:
        raise ValueError(f"the command {program} is not installed: run `make setup`")
    return next(iter(found)).load()


def run_measured(command: Sequence[str], log: Path, report: Report) -> int:
    """Run `command` to its end and return its exit status; an exception ends its process group first."""
    reader, writer = os.pipe()
    process = multiprocessing.get_context("fork").Process(
        target=_run_command, args=(list(command), writer, os.getpid())
    )
    sys.stdout.flush()
    try:
        process.start()
        os.close(writer)
        with log.open("ab") as file:
            _follow(process, reader, file, report)
        process.join()
        assert process.exitcode is not None
        return process.exitcode
    finally:
        _end_group(process)
        os.close(reader)


def _run_command(command: list[str], output: int, parent: int) -> None:
    """In the forked process: become what a shell would have started."""
    os.setsid()
    die_with(parent)
    own_progress_lock()
    for sign in (signal.SIGTERM, signal.SIGINT):
        signal.signal(sign, signal.SIG_DFL if sign == signal.SIGTERM else signal.default_int_handler)
    for stream in (1, 2):
        os.dup2(output, stream)
    sys.stdout, sys.stderr = (os.fdopen(stream, "w", buffering=1, closefd=False) for stream in (1, 2))
    os.environ.setdefault("COLUMNS", str(shutil.get_terminal_size().columns))
    keep_freed_memory()
    sys.argv = command
    sys.exit(entry_point(command[0])())


def _follow(process: BaseProcess, output: int, log: BinaryIO, report: Report) -> None:
    start, peak, sampled = time.monotonic(), 0, float("-inf")
    while True:
        finished = not process.is_alive()
        readable, _, _ = select.select([output], [], [], 0.0 if finished else 0.2)
        chunk = os.read(output, 1 << 16) if readable else b""
        _tee(chunk, log)
        if finished and not chunk:
            report(time.monotonic() - start, peak)
            return
        if time.monotonic() - sampled >= SAMPLE_SECONDS:
            sampled = time.monotonic()
            peak = max(peak, tree_memory(process.pid or 0))
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


def _end_group(process: BaseProcess) -> None:
    """Interrupt what is left of the group, politely first. Nothing to do after a normal end."""
    if process.pid is None:
        return
    for sign, seconds in ((signal.SIGINT, 10.0), (signal.SIGKILL, 5.0)):
        try:
            os.killpg(process.pid, sign)
        except ProcessLookupError:
            break
        process.join(seconds)
