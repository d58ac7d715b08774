"""`kill -9` at any instant costs no finished part, and no episode is torn or doubled.

Frames are made up here, for what is tested is how files come to be; `benchmarks/kill_campaign.py` kills the
whole command, simulator and all, as often as you like.
"""

import multiprocessing
import os
import random
import resource
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.integrity import whole_dataset
from lerobot_dataset_maniskill.manifest import planned_parts
from lerobot_dataset_maniskill.recorder import count_episodes, merge
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.episodes import recorded_episodes
from lerobot_wmrl.files import writing
from lerobot_wmrl.progress import own_progress_lock
from tests.lerobot_dataset_maniskill.made_up import ROWS, write_missing

KILLS = 20


def write_in_own_process(config: RecordConfig, work: Path) -> None:
    """What is killed."""
    own_progress_lock()
    write_missing(config, work)


def write_little(config: RecordConfig, work: Path, limit: int) -> None:
    """The same where no file may grow beyond `limit` bytes. Exit status 3 if the error says what to do."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        with writing("output_dir", work):
            write_missing(config, work)
    except ValueError as error:
        sys.exit(3 if "--output_dir=" in str(error) and "same command continues" in str(error) else 4)


def test_a_disk_that_is_full_costs_only_the_unfinished_part(tmp_path: Path) -> None:
    env = WmrlManiSkillEnv(image_size=64)
    config = RecordConfig(tmp_path / "dataset", env=env, num_episodes=3, part_episodes=1)
    work, parts = tmp_path / "work", planned_parts(config)
    work.mkdir()
    write_missing(replace(config, num_episodes=1), work)
    first = (work / parts[0].name / "meta" / "info.json").stat().st_mtime_ns
    for limit, finished in ((3000, 1), (1 << 30, 3)):
        process = multiprocessing.get_context("fork").Process(target=write_little, args=(config, work, limit))
        process.start()
        process.join()
        assert process.exitcode == (0 if finished == 3 else 3)
        assert [part.name for part in parts if (work / part.name).exists()] == [
            part.name for part in parts[:finished]
        ]
    assert (work / parts[0].name / "meta" / "info.json").stat().st_mtime_ns == first
    assert all(whole_dataset(work / part.name, 1) is None for part in parts)


def test_twenty_kills_cost_nothing_that_was_finished(tmp_path: Path) -> None:
    config = RecordConfig(
        output_dir=tmp_path / "dataset", env=WmrlManiSkillEnv(image_size=64), num_episodes=90, part_episodes=2
    )
    work, parts = tmp_path / "work", planned_parts(config)
    work.mkdir()
    rng, finished = random.Random(0), {}
    for _ in range(KILLS):
        process = multiprocessing.get_context("fork").Process(
            target=write_in_own_process, args=(config, work)
        )
        process.start()
        time.sleep(rng.uniform(0.01, 0.7))
        if process.pid is not None and process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
        process.join()
        info = {part.name: work / part.name / "meta" / "info.json" for part in parts}
        now = {name: path.stat().st_mtime_ns for name, path in info.items() if path.exists()}
        assert finished.items() <= now.items(), "a finished part was lost or written again"
        assert all(whole_dataset(work / name, 2) is None for name in now.keys() - finished.keys())
        finished = now
    assert finished
    write_missing(config, work)
    merge(config, work, parts)
    assert whole_dataset(tmp_path / "dataset", count_episodes(parts)) is None
    table = recorded_episodes(tmp_path / "dataset")
    assert sorted(table["seed"]) == list(range(90))
    assert set(table["length"]) == {ROWS}
