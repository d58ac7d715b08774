"""`kill -9` at any instant costs no finished part, and no episode is torn or doubled.

Frames are made up here, for what is tested is how files come to be.
"""

import random
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_dataset_maniskill.manifest import planned_parts
from lerobot_dataset_maniskill.recorder import merge
from lerobot_dataset_maniskill.writer import find_damage
from lerobot_wmrl.common.constants import START_SEED
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from tests.lerobot_dataset_maniskill.killed_writers import ADVISED, Order, Writers, running_writers
from tests.lerobot_dataset_maniskill.made_up import ROWS, source_of, write_missing

KILLS = 20


@pytest.fixture
def writers() -> Iterator[Writers]:
    with running_writers() as writers:
        yield writers


def test_a_disk_that_is_full_costs_only_the_unfinished_part(tmp_path: Path, writers: Writers) -> None:
    order = Order(str(tmp_path), num_episodes=3, part_episodes=1)
    work, parts = order.work, planned_parts(order.config)
    work.mkdir()
    write_missing(replace(order.config, num_episodes=1), work)
    first = (work / parts[0].name / "meta" / "info.json").stat().st_mtime_ns
    for limit, finished, status in ((3000, 1, ADVISED), (1 << 30, 3, 0)):
        assert writers.run(replace(order, limit=limit)) == status
        assert [part.name for part in parts if (work / part.name).exists()] == [
            part.name for part in parts[:finished]
        ]
    assert (work / parts[0].name / "meta" / "info.json").stat().st_mtime_ns == first
    assert all(find_damage(work / part.name, 1) is None for part in parts)


def test_twenty_kills_cost_nothing_that_was_finished(tmp_path: Path, writers: Writers) -> None:
    order = Order(str(tmp_path), num_episodes=50, part_episodes=2)
    work, parts = order.work, planned_parts(order.config)
    work.mkdir()
    for num_episodes in (2, 4):  # The first one waits for the program to import everything.
        began = time.monotonic()
        assert writers.run(replace(order, num_episodes=num_episodes)) == 0
    one_part = time.monotonic() - began
    rng, finished = random.Random(0), {}
    for _ in range(KILLS):
        kill_after = rng.uniform(0.01, 2 * one_part)
        status = writers.run(replace(order, kill_after=kill_after))
        assert status == -signal.SIGKILL, "it was not interrupted"
        info = {part.name: work / part.name / "meta" / "info.json" for part in parts}
        now = {name: path.stat().st_mtime_ns for name, path in info.items() if path.exists()}
        assert finished.items() <= now.items(), "a finished part was lost or written again"
        assert all(find_damage(work / name, 2) is None for name in now.keys() - finished.keys())
        # A busy machine may have made the first measurement too long: later kills come sooner.
        one_part = min(one_part, kill_after / max(1, len(now) - len(finished)))
        finished = now
    write_missing(order.config, work)
    merge(source_of(order.config), work, order.config.root, order.config.dataset_id)
    assert find_damage(tmp_path / "dataset", 50) is None
    table = read_episodes(open_dataset(tmp_path / "dataset"))
    assert sorted(table.columns[START_SEED]) == list(range(50))
    assert set(table.length) == {ROWS}
