"""Run stages in order and remember, in the output folder, which are finished: a second call continues.

Each stage is one console command. It runs in a forked process, which shows and logs its output and is
measured. Forking from a process that has imported the libraries saves every stage the ten seconds of import.
With CUDA, which does not survive a fork, the process then starts the command anew.
"""

import importlib
import importlib.metadata
import json
import multiprocessing
import os
import select
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import huggingface_hub.constants
import psutil
import torch
from lerobot.configs import parser

from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.lerobot_commands import whole_checkpoint
from lerobot_wmrl.common.precision import keep_freed_memory
from lerobot_wmrl.common.processes import die_with, find_program, not_installed, own_progress_lock
from lerobot_wmrl.common.quick_parsing import parsed_quickly

MARKER = "settings.json"
"""File of the settings that stages are made from, in their folder."""

FAILED = "failed"
"""In the record of an optional stage that failed: the last line of its output."""

SAMPLE_SECONDS = 1.0
"""Seconds between two samples of memory and two reports of progress."""

PRELOADED = ("lerobot.scripts.lerobot_train", "lerobot.scripts.lerobot_eval", "lerobot_env_wmrl")

Progress = Callable[[float, int], None]
"""Called about once a second with the seconds since the start and the peak memory so far in bytes."""


def never(status: int) -> bool:
    """Return False."""
    return False


@dataclass(frozen=True)
class Stage:
    """One console command.

    The command is made when the stage starts: some of its flags depend on what earlier stages left.

    `optional` is called with the exit status of a command that failed. If it returns True, the later stages
    run, and this one is tried again only as long as none of them has begun.

    `fresh` is a folder in which the command refuses what an interrupted call left. It is removed first,
    unless it has a checkpoint from which lerobot-train continues.
    """

    name: str
    title: str
    command: Callable[[], list[str]]
    optional: Callable[[int], bool] = never
    fresh: Path | None = None


class StageError(RuntimeError):
    """A stage's command failed; the message names the stage, its log, and how to go on."""


def interrupt(signal_number: int, frame: object) -> NoReturn:
    """Let `kill` end a command as Ctrl-C does: with its stage, and with a word on how to go on."""
    raise KeyboardInterrupt


def run_stage_command[Config: RunConfig](
    function: Callable[[Config], None],
    config_class: type[Config],
    expand: Callable[[Sequence[str]], list[str]],
) -> None:
    """Run a console command that is made of stages, as `run_command` runs the others."""
    signal.signal(signal.SIGTERM, interrupt)
    try:
        run_command(function, config_class, expand)
    except StageError as error:
        sys.exit(f"error: {error}")


def run_stages(
    stages: Sequence[Stage], output_dir: Path, modules: Sequence[str] = (), offline: bool = False
) -> None:
    """Run every stage that is not finished.

    Args:
        stages: in order.
        output_dir: folder of their records and logs.
        modules: what else to import once before the stages, beside LeRobot's commands.
        offline: keep the stages off the network.

    Raises:
        StageError: a command fails.
    """
    preload(modules, offline)
    for number, stage in enumerate(stages, start=1):
        record = read_record(output_dir, stage.name)
        heading = f"[{number}/{len(stages)}] {stage.title}"
        if record.get("finished"):
            print(f"{heading}: done in {record['seconds']:.0f} s", flush=True)
        elif record.get(FAILED) and any(read_record(output_dir, later.name) for later in stages[number:]):
            print(f"{heading}: failed, and the others went on", flush=True)
        else:
            run_stage(stage, heading, output_dir, record)


def run_stage(stage: Stage, heading: str, output_dir: Path, record: dict[str, Any]) -> None:
    """Run one stage. Its record is written about once a second, so an interruption loses no time measured."""
    command = stage.command()
    if stage.fresh is not None and whole_checkpoint(stage.fresh) is None:
        shutil.rmtree(stage.fresh, ignore_errors=True)
    seconds, peak = record.get("seconds", 0.0), record.get("peak_memory_bytes", 0)
    # The first command is the one to copy: a resumed stage may run another one.
    record = {"name": stage.name, "title": stage.title, "command": record.get("command", shlex.join(command))}

    def save(elapsed: float, memory: int, finished: bool = False) -> None:
        measured = {
            "seconds": seconds + elapsed,
            "peak_memory_bytes": max(peak, memory),
            "finished": finished,
        }
        record.update(measured)
        write_json(record_path(output_dir, stage.name), record)

    print(f"\n{heading}\n$ {shlex.join(command)}", flush=True)
    log = output_dir / "logs" / f"{stage.name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    status = run_measured(command, log, save)
    if status > 0 and stage.optional(status):  # below 0 it was killed
        record[FAILED] = last_line(log)
        save(record["seconds"] - seconds, record["peak_memory_bytes"])
        print(f"{stage.title}: exit status {status}. Its output is in {log}; the others go on.", flush=True)
        return
    if status == STOPPED:  # it would stop again
        raise StageError(f"{stage.title}: {last_line(log).removeprefix('stopped: ')}")
    if status != 0:
        raise StageError(
            f"{stage.title}: exit status {status}. Its output is in {log}; run the same command again to "
            "continue."
        )
    save(record["seconds"] - seconds, record["peak_memory_bytes"], finished=True)


def last_line(log: Path) -> str:
    """Return the last line of a command's output that is not empty."""
    lines = log.read_text(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "no output")


def record_path(output_dir: Path, name: str) -> Path:
    return output_dir / "stages" / f"{name}.json"


def read_record(output_dir: Path, name: str) -> dict[str, Any]:
    """Return what is known of the stage of that name, nothing before its first second."""
    path = record_path(output_dir, name)
    return json.loads(path.read_text()) if path.exists() else {}


def preload(modules: Sequence[str], offline: bool) -> None:
    """Import once what the stages need."""
    if offline and "HF_HUB_OFFLINE" not in os.environ:
        os.environ["HF_HUB_OFFLINE"] = "1"  # for processes that a stage starts
        huggingface_hub.constants.HF_HUB_OFFLINE = True  # the library read the variable at its import
    for module in (*PRELOADED, *modules):
        importlib.import_module(module)


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
    stages that render wait for ever. Where stages are no forks, it is called in this process.
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
