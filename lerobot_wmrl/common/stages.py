"""Run stages in order and remember, in the output folder, which are finished: a second call continues.

Each stage is one console command, run in a fork (`forks`).
"""

import importlib
import json
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import huggingface_hub.constants

from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.forks import run_measured
from lerobot_wmrl.common.lerobot_commands import whole_checkpoint

MARKER = "settings.json"
"""File of the settings that stages are made from, in their folder."""

FAILED = "failed"
"""In the record of an optional stage that failed: the last line of its output."""

PRELOADED = ("lerobot.scripts.lerobot_train", "lerobot.scripts.lerobot_eval", "lerobot_env_wmrl")


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
