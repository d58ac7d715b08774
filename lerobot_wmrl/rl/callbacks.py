"""What is done between iterations: looked at, judged, recorded anew. None of it touches a training's dice.

A training knows callbacks by `due`, `run` and `apply` only. What one finds is kept beside the checkpoints, in
`<output_dir>/<name>/<iteration>/record.json`: it is found once, also if the training is killed in between.
"""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from lerobot.common.train_utils import get_step_identifier
from lerobot.utils.random_utils import get_rng_state, set_rng_state
from lerobot.utils.utils import flatten_dict

from lerobot_wmrl.common.distributed import rank_and_size, wait_for_all
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.tracking import Tracker

RECORD_FILE = "record.json"
REAL_STEPS = "real_steps"
"""In a record: control steps of the real robot or simulator that finding it has taken."""

Record = dict[str, Any]
"""JSON: what was found at an iteration. Its numbers are logged as `<name>/<key>`."""


class Callback(Protocol):
    """Something to be done between two iterations."""

    name: str

    def due(self, iteration: int) -> bool:
        """Whether after so many iterations."""

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """Do it, with the policy's checkpoint at hand. What `folder` holds, the same call left, killed."""

    def apply(self, records: Mapping[int, Record]) -> None:
        """Draw the conclusion from all records so far, by iteration: after a run, and on resuming.

        TrainingStopped if the training must not go on.
        """


class Callbacks:
    """Runs callbacks, in order, and keeps what they find. Of several processes the first runs them, and all
    read what it found."""

    def __init__(self, callbacks: Sequence[Callback], output_dir: Path, total: int, tracker: Tracker) -> None:
        self.callbacks, self.output_dir, self.total, self.tracker = callbacks, output_dir, total, tracker
        self.records: dict[str, dict[int, Record]] = {callback.name: {} for callback in callbacks}

    def resume(self, iteration: int) -> None:
        """Take up what was found up to here; what was found later belongs to iterations that are repeated."""
        for callback in self.callbacks:
            self._take_up(callback.name, iteration)
        for callback in self.callbacks:
            found = self.records[callback.name]
            if iteration in found:
                self._log(callback.name, iteration)
            if found:
                self._apply(callback)

    def _take_up(self, name: str, iteration: int) -> None:
        for folder in sorted((self.output_dir / name).glob("[0-9]*")):
            if int(folder.name) > iteration:
                shutil.rmtree(folder, ignore_errors=True)
            elif (folder / RECORD_FILE).is_file():
                self.records[name][int(folder.name)] = json.loads((folder / RECORD_FILE).read_text())

    def _apply(self, callback: Callback) -> None:
        """Also when resumed, which has the training's dice at the checkpoint: to make a model rolls some."""
        with preserved_randomness():
            callback.apply(self.records[callback.name])

    def due(self, iteration: int) -> bool:
        """Whether any of them has something to do that is not done yet."""
        return any(self._pending(callback, iteration) for callback in self.callbacks)

    def run(self, iteration: int, checkpoint: Path) -> None:
        """Those that are due. The random numbers of the training go on as if nothing had happened."""
        for callback in self.callbacks:
            if self._pending(callback, iteration):
                folder = record_folder(self.output_dir, callback.name, iteration, self.total)
                if rank_and_size()[0] == 0:
                    with preserved_randomness():
                        write_json(folder / RECORD_FILE, callback.run(iteration, checkpoint, folder))
                wait_for_all()
                record = json.loads((folder / RECORD_FILE).read_text())
                self.records[callback.name][iteration] = record
                self._log(callback.name, iteration)
                self._apply(callback)

    def real_steps(self) -> dict[str, float]:
        """Steps in reality so far, by what they were spent on: `real_steps/<name>`."""
        return {
            f"{REAL_STEPS}/{name}": sum(record.get(REAL_STEPS, 0) for record in records.values())
            for name, records in self.records.items()
        }

    def _log(self, name: str, iteration: int) -> None:
        record = self.records[name][iteration]
        self.tracker.log(iteration, {**numbers(name, record), **self.real_steps()}, "eval")

    def _pending(self, callback: Callback, iteration: int) -> bool:
        return callback.due(iteration) and iteration not in self.records[callback.name]


def record_folder(output_dir: Path, name: str, iteration: int, total: int) -> Path:
    """Where a callback of this name leaves what it makes, called as the checkpoint of the iteration."""
    return output_dir / name / get_step_identifier(iteration, total)


def has_record(output_dir: Path, name: str, iteration: int, total: int) -> bool:
    """Whether the callback of this name was done with."""
    return (record_folder(output_dir, name, iteration, total) / RECORD_FILE).is_file()


def numbers(name: str, record: Record) -> dict[str, float]:
    """What can be plotted, `<name>/<key>` with slashes for nesting; steps are logged as totals."""
    return {
        f"{name}/{key}": value
        for key, value in flatten_dict(record).items()
        if isinstance(value, int | float) and not isinstance(value, bool) and key != REAL_STEPS
    }


@contextmanager
def preserved_randomness() -> Iterator[None]:
    """Put Python's, numpy's and torch's generators back to where they were."""
    state = get_rng_state()
    try:
        yield
    finally:
        set_rng_state(state)
