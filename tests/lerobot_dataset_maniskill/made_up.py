"""Recordings without a simulator: the recorder's own files, from pictures that tell their row and camera."""

import shutil
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import EpisodePlan
from lerobot_dataset_maniskill.recorder import merge, missing_parts
from lerobot_dataset_maniskill.simulated import ManiSkillEpisodes
from lerobot_dataset_maniskill.worker import PartRecorder, ScriptedController
from lerobot_dataset_maniskill.writer import StartColumns, StepResult, add_step
from lerobot_wmrl.common.constants import TASK_NAMES
from lerobot_wmrl.maniskill.episode import Frame

ROWS = 10
SUCCESS_ROW = 5
"""The first row whose action succeeds, in every episode that is no near miss."""

BRIGHTER = 20
"""How much brighter a picture is than that of the row before, in its camera's colour channel."""

NOISE = 10


class MadeUpRecorder(PartRecorder):
    """Writes made-up episodes where the recorder writes simulated ones."""

    def __init__(self, config: RecordConfig, folder: Path) -> None:
        self.config, self.folder, self.controller = config, folder, ScriptedController(config.planner)

    def _record_episode(self, dataset: LeRobotDataset, plan: EpisodePlan) -> bool:
        rng = np.random.default_rng(plan.seed)
        succeeds = plan.kind != "near_miss"
        start = StartColumns(f"{plan.task} it", TASK_NAMES.index(plan.task), plan)
        for row in range(ROWS):
            frame = self._frame(row, rng, success=False)
            following = self._frame(row + 1, rng, success=succeeds and row >= SUCCESS_ROW)
            result = StepResult(following, truncated=row == ROWS - 1 and not succeeds)
            add_step(dataset, start, frame, np.full(7, row / ROWS), result)
        dataset.save_episode()
        return succeeds

    def _frame(self, row: int, rng: np.random.Generator, success: bool) -> Frame:
        env, images = self.config.maniskill, {}
        for camera in env.cameras:
            images[camera] = rng.integers(0, NOISE, (env.image_size, env.image_size, 3), dtype=np.uint8)
            images[camera][..., env.cameras.index(camera)] += BRIGHTER * row
        return Frame(images, {}, np.zeros(8, np.float32), row / ROWS, success)


def source_of(config: RecordConfig) -> ManiSkillEpisodes:
    return ManiSkillEpisodes(config, config.recorded_content())


def write_missing(config: RecordConfig, work: Path) -> None:
    """What the command does between claiming its folder and merging."""
    source, recorder = source_of(config), MadeUpRecorder(config, work)
    missing = missing_parts(work, source.parts)
    for part in source.planned:
        if part.name in missing:
            recorder.record(part, lambda result: None)


def record_made_up(config: RecordConfig) -> None:
    """The whole recording, in `config.output_dir`."""
    work = config.root.with_name("work")
    work.mkdir()
    write_missing(config, work)
    merge(source_of(config), work, config.root, config.dataset_id)
    shutil.rmtree(work)
