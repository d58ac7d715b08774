"""Console commands and functions that run in forks of this process.

Forking from a process that has imported the libraries saves every command the ten seconds of import. With
CUDA, which does not survive a fork, the process then starts the command anew, and functions are called in
this process.
"""

import importlib.metadata
import multiprocessing
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import BinaryIO

import psutil
import torch
from lerobot.configs import parser

from lerobot_wmrl.common.precision import keep_freed_memory
from lerobot_wmrl.common.processes import die_with, find_program, not_installed, own_progress_lock
from lerobot_wmrl.common.quick_parsing import parsed_quickly

SAMPLE_SECONDS = 1.0
"""Seconds between two samples of memory and two reports of progress."""

Progress = Callable[[float, int], None]
"""Called about once a second with the seconds since the start and the peak memory so far in bytes."""


def entry_point(program: str) -> Callable[[], int | None]:
    """Return the function that the console command calls. Raises ValueError if no package installs it."""
    entry_points = importlib.metadata.entry_points(group="console_scripts", name=program)
    if not entry_points:
        raise not_installed(program)
    return next(iter(entry_points)).load()


def may_fork() -> bool:
    """Return whether a fork can do what this process can: not if this process has asked for CUDA, and not on
    macOS."""
    return sys.platform == "linux" and not torch.cuda.is_available()


def in_fork[**P, T](function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function in a fork of this process, and return or raise what it does; all of it is pickled.

    What it leaves in libraries ends with the fork: once a process has rendered with OpenGL, as MuJoCo does,
    others that render wait for ever. Where this process must not fork (`may_fork`), it is called in it.
    """
    if not may_fork():
        return function(*args, **kwargs)
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(1, context, _begin_fork, (os.getpid(),)) as fork:
        return fork.submit(function, *args, **kwargs).result()


def _begin_fork(parent: int) -> None:
    die_with(parent)
    own_progress_lock()


def run_measured(command: Sequence[str], log: Path, progress: Progress) -> int:
    """Run `command` to its end and return its exit status; an exception ends its process group first."""
    reader, writer = os.pipe()
    process = multiprocessing.get_context("fork").Process(
        target=_run_command, args=(list(command), writer, os.getpid(), not may_fork())
    )
    sys.stdout.flush()
    try:
        process.start()
        os.close(writer)
        with log.open("ab") as file:
            _follow(process, reader, file, progress)
        process.join()
        assert process.exitcode is not None
        return process.exitcode
    finally:
        _end_group(process)
        os.close(reader)


def _run_command(command: list[str], output: int, parent: int, anew: bool) -> None:
    """Become, in the forked process, what a shell would have started; `anew` by starting it."""
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
    if anew:
        os.environ["PYTHONUNBUFFERED"] = "1"
        os.execv(find_program(command[0]), command)
    sys.argv = command
    for remembered in (parser._config_path_args, parser._config_yaml_overrides):
        remembered.clear()  # of this program's --config_path, which LeRobot ranks above a command's flags
    with nullcontext() if {"--help", "-h"} & {*command} else parsed_quickly():
        sys.exit(entry_point(command[0])())


def _follow(process: BaseProcess, output: int, log: BinaryIO, progress: Progress) -> None:
    """Copy the output to the log and the screen, and report time and memory, until the process ends."""
    start, peak, sampled = time.monotonic(), 0, float("-inf")
    while True:
        finished = not process.is_alive()
        readable, _, _ = select.select([output], [], [], 0.0 if finished else 0.2)
        chunk = os.read(output, 1 << 16) if readable else b""
        if chunk:
            log.write(chunk)
            log.flush()
            sys.stdout.buffer.write(chunk)
            sys.stdout.flush()
        if finished and not chunk:
            progress(time.monotonic() - start, peak)
            return
        if time.monotonic() - sampled >= SAMPLE_SECONDS:
            sampled = time.monotonic()
            peak = max(peak, tree_memory(process.pid or 0))
            progress(sampled - start, peak)


def tree_memory(pid: int) -> int:
    """Sum the resident bytes of a process and its descendants; shared pages count once for each."""
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
    """Interrupt what is left of the process group, then kill it. Does nothing after a normal end."""
    if process.pid is None:
        return
    for sign, seconds in ((signal.SIGINT, 10.0), (signal.SIGKILL, 5.0)):
        try:
            os.killpg(process.pid, sign)
        except ProcessLookupError:
            break
        process.join(seconds)
