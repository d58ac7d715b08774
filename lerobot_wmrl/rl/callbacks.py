"""Callbacks between iterations, such as measuring success. They do not change the training's random numbers.

A callback returns a record, which is kept in `<output_dir>/<name>/<iteration>/record.json`. A training that
was killed and resumed reads the record instead of running the callback again.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from lerobot.utils.utils import flatten_dict

from lerobot_wmrl.common.checkpoints import checkpoint_name
from lerobot_wmrl.common.distributed import is_first_process, wait_for_all
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.tracking import Tracker
from lerobot_wmrl.rl.seeds import preserved_randomness

RECORD_FILE = "record.json"
REAL_STEPS = "real_steps"
"""Key of a record: control steps that the callback has taken outside the world model."""

Record = dict[str, Any]
"""JSON that a callback returns. Its numbers are logged as `<name>/<key>`."""


class Callback(Protocol):
    """Something that runs between two iterations."""

    name: str

    def due(self, iteration: int) -> bool:
        """Return whether to run after so many iterations."""

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """Run, and return the record.

        Args:
            iteration: finished iterations.
            checkpoint: the policy's checkpoint of this iteration.
            folder: where to write files. If an earlier run of this call was killed, its files are there.
        """

    def apply(self, records: Mapping[int, Record]) -> None:
        """Act on all records so far, by iteration. Called after `run` and when a training is resumed.

        Raises:
            TrainingStopped: the training must not go on.
        """


class Callbacks:
    """Runs callbacks in order and keeps their records. With several processes the first one runs them, and
    all read the records."""

    def __init__(self, callbacks: Sequence[Callback], output_dir: Path, total: int, tracker: Tracker) -> None:
        self.callbacks, self.output_dir, self.total, self.tracker = callbacks, output_dir, total, tracker
        self.records: dict[str, dict[int, Record]] = {callback.name: {} for callback in callbacks}

    def resume(self, iteration: int) -> None:
        """Read the records up to `iteration`, and remove later ones, whose iterations are repeated."""
        for callback in self.callbacks:
            self._read_records(callback.name, iteration)
        for callback in self.callbacks:
            records = self.records[callback.name]
            if iteration in records:
                self._log(callback.name, iteration)
            if records:
                self._apply(callback)

    def _read_records(self, name: str, iteration: int) -> None:
        for folder in (self.output_dir / name).glob("[0-9]*"):
            if int(folder.name) > iteration:
                shutil.rmtree(folder, ignore_errors=True)
        self.records[name] |= read_records(self.output_dir, name)

    def _apply(self, callback: Callback) -> None:
        """Apply, and restore the training's generators: loading a model draws random initial weights."""
        with preserved_randomness():
            callback.apply(self.records[callback.name])

    def due(self, iteration: int) -> bool:
        """Return whether any callback has to run here and has not."""
        return any(self._pending(callback, iteration) for callback in self.callbacks)

    def run(self, iteration: int, checkpoint: Path) -> None:
        """Run the callbacks that are due, and restore the training's generators afterwards."""
        for callback in self.callbacks:
            if self._pending(callback, iteration):
                folder = record_folder(self.output_dir, callback.name, iteration, self.total)
                if is_first_process():
                    with preserved_randomness():
                        write_json(folder / RECORD_FILE, callback.run(iteration, checkpoint, folder))
                wait_for_all()
                record = read_record(self.output_dir, callback.name, iteration, self.total)
                self.records[callback.name][iteration] = record
                self._log(callback.name, iteration)
                self._apply(callback)

    def real_steps(self) -> dict[str, float]:
        """Return the steps outside the world model so far, `real_steps/<name>` for each callback."""
        return {
            f"{REAL_STEPS}/{name}": sum(record.get(REAL_STEPS, 0) for record in records.values())
            for name, records in self.records.items()
        }

    def _log(self, name: str, iteration: int) -> None:
        record = self.records[name][iteration]
        self.tracker.log(iteration, {**record_metrics(name, record), **self.real_steps()}, "eval")

    def _pending(self, callback: Callback, iteration: int) -> bool:
        return callback.due(iteration) and iteration not in self.records[callback.name]


def record_folder(output_dir: Path, name: str, iteration: int, total: int) -> Path:
    """Return the folder of a callback's record. Its name is that of the iteration's checkpoint."""
    return output_dir / name / checkpoint_name(total, iteration)


def has_record(output_dir: Path, name: str, iteration: int, total: int) -> bool:
    """Return whether the callback of this name has a record of the iteration."""
    return (record_folder(output_dir, name, iteration, total) / RECORD_FILE).is_file()


def read_records(output_dir: Path, name: str) -> dict[int, Record]:
    """Return all records of the callback of this name, by iteration."""
    found = sorted((output_dir / name).glob(f"[0-9]*/{RECORD_FILE}"))
    return {int(path.parent.name): json.loads(path.read_text()) for path in found}


def read_record(output_dir: Path, name: str, iteration: int, total: int) -> Record:
    """Return the record of the callback of this name."""
    record: Record = json.loads((record_folder(output_dir, name, iteration, total) / RECORD_FILE).read_text())
    return record


def record_metrics(name: str, record: Record) -> dict[str, float]:
    """Return the numbers of a record as `<name>/<key>`, with slashes for nesting. `real_steps` is left out,
    because it is logged as a total."""
    return {
        f"{name}/{key}": value
        for key, value in flatten_dict(record).items()
        if isinstance(value, int | float) and not isinstance(value, bool) and key != REAL_STEPS
    }
