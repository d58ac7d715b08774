"""Writers of made-up episodes that are killed or run out of disk, for `test_kills.py`.

A program of its own, since forks are safe only of a process that has no threads, and those of a renderer
leave one in so many forks hanging. Every line it is given is an `Order` in JSON; it answers with the exit
status of the writer.
"""

import json
import multiprocessing
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from subprocess import PIPE, Popen

sys.path.insert(0, str(Path(__file__).parent))

from made_up import write_missing

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.files import writing
from lerobot_wmrl.common.processes import own_progress_lock
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

ADVISED, NOT_ADVISED = 3, 4
"""Exit status of a writer whose disk is full: whether its error says what to do."""


@dataclass(frozen=True)
class Order:
    """Write what is missing of a recording below `root`, and be killed after so many seconds.

    Args:
        limit: bytes that no file may grow beyond.
    """

    root: str
    num_episodes: int
    part_episodes: int
    kill_after: float = 120.0
    limit: int = 1 << 30

    @property
    def config(self) -> RecordConfig:
        """Of the recording."""
        return RecordConfig(
            Path(self.root) / "dataset",
            env=WmrlManiSkillEnv(image_size=64),
            num_episodes=self.num_episodes,
            part_episodes=self.part_episodes,
        )

    @property
    def work(self) -> Path:
        """Where the parts are."""
        return Path(self.root) / "work"


def write(order: Order) -> None:
    """In a process of its own."""
    own_progress_lock()
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (order.limit, order.limit))
    try:
        with writing("output_dir", order.work):
            write_missing(order.config, order.work)
    except ValueError as error:
        advised = "--output_dir=" in str(error) and "same command continues" in str(error)
        sys.exit(ADVISED if advised else NOT_ADVISED)


def carry_out(order: Order) -> int | None:
    """→ exit status of the writer"""
    process = multiprocessing.get_context("fork").Process(target=write, args=(order,))
    process.start()
    process.join(order.kill_after)
    process.kill()
    process.join()
    return process.exitcode


class Writers:
    """The program, seen by who gives the orders."""

    def __init__(self, program: Popen[str]) -> None:
        self.program = program

    def run(self, order: Order) -> int:
        """→ exit status of the writer"""
        assert self.program.stdin is not None
        assert self.program.stdout is not None
        print(json.dumps(asdict(order)), file=self.program.stdin, flush=True)
        return int(self.program.stdout.readline())


@contextmanager
def running_writers() -> Iterator[Writers]:
    """Start the program, and end it."""
    with Popen([sys.executable, __file__], stdin=PIPE, stdout=PIPE, text=True) as program:
        yield Writers(program)


if __name__ == "__main__":
    for line in sys.stdin:
        print(carry_out(Order(**json.loads(line))), flush=True)
