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
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.integrity import whole_dataset
from lerobot_dataset_maniskill.manifest import EpisodePlan, planned_parts
from lerobot_dataset_maniskill.recorder import count_episodes, merge, missing_parts
from lerobot_dataset_maniskill.worker import PartRecorder
from lerobot_dataset_maniskill.writer import Outcome, StartColumns, add_step
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.episodes import recorded_episodes
from lerobot_wmrl.files import writing
from lerobot_wmrl.maniskill.simulation import Frame
from lerobot_wmrl.progress import own_progress_lock

KILLS = 20
ROWS = 6


class MadeUpRecorder(PartRecorder):
    """The recorder's own files, from pictures of noise."""

    def __init__(self, config: RecordConfig, folder: Path) -> None:
        self.config, self.folder = config, folder

    def _record_episode(self, dataset: LeRobotDataset, plan: EpisodePlan) -> bool:
        rng = np.random.default_rng(plan.seed)
        for row in range(ROWS):
            image = rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)
            frame = Frame({"third_view": image}, {}, np.zeros(8, np.float32), 0.0, row == ROWS - 1)
            add_step(dataset, StartColumns("push it", 0, plan), frame, np.zeros(7), Outcome(frame, False))
        dataset.save_episode()
        return True


def write_missing(config: RecordConfig, work: Path) -> None:
    """What the command does between claiming its folder and merging, in a process of its own."""
    own_progress_lock()
    recorder = MadeUpRecorder(config, work)
    for part in missing_parts(work, planned_parts(config)):
        recorder.record(part, lambda result: None)


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
    config = RecordConfig(
        output_dir=tmp_path / "dataset", env=WmrlManiSkillEnv(image_size=64), num_episodes=2
    )
    work, parts = tmp_path / "work", planned_parts(config)
    work.mkdir()
    for limit, finished in ((3000, False), (1 << 30, True)):
        process = multiprocessing.get_context("fork").Process(target=write_little, args=(config, work, limit))
        process.start()
        process.join()
        assert process.exitcode == (0 if finished else 3)
        assert (work / parts[0].name).exists() == finished
    assert whole_dataset(work / parts[0].name, 2) is None


def test_twenty_kills_cost_nothing_that_was_finished(tmp_path: Path) -> None:
    config = RecordConfig(
        output_dir=tmp_path / "dataset", env=WmrlManiSkillEnv(image_size=64), num_episodes=90, part_episodes=2
    )
    work, parts = tmp_path / "work", planned_parts(config)
    work.mkdir()
    rng, finished = random.Random(0), {}
    for _ in range(KILLS):
        process = multiprocessing.get_context("fork").Process(target=write_missing, args=(config, work))
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
