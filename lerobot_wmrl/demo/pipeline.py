"""Runs the stages in order and remembers, in the output folder, what is finished: a second call continues."""

import fcntl
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.files import foreign_files, write_json
from lerobot_wmrl.demo.process import preload, run_measured
from lerobot_wmrl.demo.stages import Stage

MARKER = "settings.json"


class StageError(RuntimeError):
    """A stage's command failed; the message says which, where its log is and how to go on."""


@contextmanager
def claimed(output_dir: Path, settings: Mapping[str, Any]) -> Iterator[None]:
    """Hold a folder for stages that are made from `settings` (name → text or number).

    ValueError unless it is new, empty, or was claimed with these very settings, and is in nobody else's use.
    """
    marker = output_dir / MARKER
    if marker.exists():
        check_settings(output_dir, json.loads(marker.read_text()), settings)
    elif foreign_files(output_dir, MARKER):
        raise ValueError(
            f"--output_dir={output_dir}: holds what this command did not make; choose another folder"
        )
    else:
        write_json(marker, dict(settings))
    with marker.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"--output_dir={output_dir}: another run of this command is there") from None
        yield


def check_settings(output_dir: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """ValueError names a setting that is not what the folder was begun with."""
    for name, value in wanted.items():
        if found.get(name) != value:
            raise ValueError(
                f"--{name}={value}: {output_dir} was started with {found.get(name)}; "
                "give that value to continue, or another --output_dir"
            )


def run_stages(stages: Sequence[Stage], output_dir: Path) -> None:
    """Run every stage that is not finished. StageError when a command fails."""
    for number, stage in enumerate(stages, start=1):
        record = read_record(output_dir, stage)
        heading = f"[{number}/{len(stages)}] {stage.title}"
        if record.get("finished"):
            print(f"{heading}: done in {record['seconds']:.0f} s", flush=True)
        else:
            run_stage(stage, heading, output_dir, record)


def run_stage(stage: Stage, heading: str, output_dir: Path, record: dict[str, Any]) -> None:
    """Its file is kept up to date while it runs, so that an interruption loses no second of the time."""
    command = stage.command()
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
        write_json(record_path(output_dir, stage), record)

    print(f"\n{heading}\n$ {shlex.join(command)}", flush=True)
    log = output_dir / "logs" / f"{stage.name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    preload()
    status = run_measured(command, log, save)
    if status != 0:
        raise StageError(
            f"{stage.title}: exit status {status}. Its output is in {log}; run the demo again to continue."
        )
    save(record["seconds"] - seconds, record["peak_memory_bytes"], finished=True)


def record_path(output_dir: Path, stage: Stage) -> Path:
    return output_dir / "stages" / f"{stage.name}.json"


def read_record(output_dir: Path, stage: Stage) -> dict[str, Any]:
    path = record_path(output_dir, stage)
    return json.loads(path.read_text()) if path.exists() else {}
