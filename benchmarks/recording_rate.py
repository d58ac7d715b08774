"""Episodes a minute by kind of trajectory, and what a second recording process adds, in one run.

    python benchmarks/recording_rate.py

All tasks, three cameras of 128x128 pixels, video encoding and a dataset for every
episode included; starting the processes is not. Writes
docs/results/recording_rate.json.
"""

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import planned_parts
from lerobot_dataset_maniskill.simulated import record_in_parallel
from lerobot_dataset_maniskill.worker import PartRecorder, silence_libraries
from lerobot_wmrl.common.constants import KINDS, PLAY, TASK_NAMES
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

CAMERAS = ("third_view", "side_view", "wrist")
RESULTS = Path(__file__).parents[1] / "docs" / "results"
SEED = 5_000
WARM_UP = 2
"""Episodes that a process needs to reach its pace, each."""


@contextmanager
def recording(**fields: Any) -> Iterator[tuple[RecordConfig, Path]]:
    """A configuration for all tasks, and a folder for its parts."""
    with tempfile.TemporaryDirectory() as folder:
        env = WmrlManiSkillEnv(cameras=list(CAMERAS))
        config = RecordConfig(Path(folder) / "dataset", env=env, tasks=list(TASK_NAMES), seed=SEED, **fields)
        yield config, Path(folder)


def kind_rate(kind: str, episodes: int) -> float:
    """Episodes a minute of one kind, in this process."""
    with recording(num_episodes=episodes + WARM_UP, part_episodes=1, kinds={kind: 1.0}) as (config, folder):
        process = PartRecorder(config, folder)
        for index, part in enumerate(planned_parts(config)):
            if index == WARM_UP:
                began = time.perf_counter()
            process.record(part, lambda result: None)
        seconds = time.perf_counter() - began
        process.simulation.close()
    return 60 * episodes / seconds


def worker_rate(workers: int, episodes: int) -> float:
    """Episodes a minute of that many processes, from when each has recorded its first few on."""
    times: list[float] = []
    with recording(num_episodes=episodes, part_episodes=1, num_workers=workers) as (config, folder):
        parts = planned_parts(config)
        record_in_parallel(config, folder, parts, workers, lambda result: times.append(time.perf_counter()))
    paced = times[WARM_UP * workers :]
    return 60 * (len(paced) - 1) / (paced[-1] - paced[0])


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=12, help="of each kind; play has a quarter of them")
    parser.add_argument("--worker_episodes", type=int, default=40, help="for each number of processes")
    parser.add_argument("--output", type=Path, default=RESULTS / "recording_rate.json", help="JSON file")
    return parser


def main() -> None:
    """Measure, print, write."""
    given = make_parser().parse_args()
    silence_libraries()
    kinds = [kind for kind in KINDS if kind != "policy"]
    rates = {
        kind: kind_rate(kind, given.episodes if kind != PLAY else max(1, given.episodes // 4))
        for kind in kinds
    }
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    one, two = (worker_rate(workers, given.worker_episodes) for workers in (1, 2))
    figures = {
        "cameras": list(CAMERAS),
        "episodes_per_minute_by_kind": rates,
        "episodes_per_minute": {"one process": one, "two processes": two},
        "two_over_one": two / one,
        "peak_memory_gb_of_one": memory,
    }
    print(figures)
    write_json(given.output, figures)


if __name__ == "__main__":
    main()
