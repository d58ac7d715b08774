"""What a recording process does: simulate a part's episodes into a sub-dataset, renamed when it is whole."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.drivers import Driver, PlannerDriver, PolicyDriver
from lerobot_dataset_maniskill.manifest import EpisodePlan, Part
from lerobot_dataset_maniskill.planners.kinds import PLAY_STEPS
from lerobot_dataset_maniskill.quiet import silence_libraries
from lerobot_dataset_maniskill.writer import HOLD_FRAMES, Outcome, StartColumns, add_step, create_dataset
from lerobot_wmrl.common.constants import PLAY
from lerobot_wmrl.common.progress import own_progress_lock
from lerobot_wmrl.maniskill.backend import leave_with_command
from lerobot_wmrl.maniskill.tasks import task_of


@dataclass(frozen=True)
class EpisodeResult:
    """What the progress bar and the card need of an episode."""

    part: int
    kind: str
    success: bool


Report = Callable[[EpisodeResult], None]


@contextmanager
def whole_part(
    config: RecordConfig, folder: Path, part: Part, cameras: Sequence[str], image_size: int
) -> Iterator[LeRobotDataset]:
    """An empty dataset to fill; it then stands in `folder` under the part's name, unless that fails."""
    partial = folder / f".{part.name}.{os.getpid()}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    dataset = create_dataset(partial, config.dataset_id, cameras, image_size, config.depth)
    yield dataset
    dataset.finalize()
    partial.replace(folder / part.name)


class PartRecorder:
    """A simulation and a driver that record parts one after the other."""

    def __init__(self, config: RecordConfig, folder: Path) -> None:
        env = config.maniskill
        self.config, self.folder = config, folder
        self.simulation = env.create_simulation(config.depth)
        self.driver: Driver = (
            PlannerDriver(config.planner)
            if config.policy is None
            else PolicyDriver(config.policy, config.exploration)
        )

    def record(self, part: Part, report: Report) -> None:
        """Record `part`; its folder appears under its final name only when it is whole."""
        env = self.config.maniskill
        with whole_part(self.config, self.folder, part, env.cameras, env.image_size) as dataset:
            for plan in part.episodes:
                report(EpisodeResult(part.index, plan.kind, self._record_episode(dataset, plan)))

    def _steps(self, plan: EpisodePlan) -> int:
        """At most so many rows."""
        if plan.kind == PLAY:
            return PLAY_STEPS
        return self.config.maniskill.episode_length or self.simulation.task.horizon

    def _record_episode(self, dataset: LeRobotDataset, plan: EpisodePlan) -> bool:
        """Simulate and store one episode: to HOLD_FRAMES after success first holds, or to the horizon.

        Play goes on whatever happens. Returns whether the episode succeeded.
        """
        simulation = self.simulation
        simulation.task = task_of(plan.task)
        frame = simulation.reset(plan.scene, plan.seed)
        self.driver.begin(simulation, plan)
        start = StartColumns(simulation.instruction, simulation.task.index, plan)
        steps_left = self._steps(plan)
        succeeded = False
        while steps_left > 0:
            action = self.driver.act(simulation, frame)
            following = simulation.step(action)
            steps_left -= 1
            if following.success and not succeeded and plan.kind != PLAY:
                succeeded, steps_left = True, HOLD_FRAMES
            outcome = Outcome(following, truncated=steps_left == 0 and not succeeded)
            add_step(dataset, start, frame, action, outcome)
            frame = following
        dataset.save_episode()
        return succeeded


def serve_parts(config: RecordConfig, folder: Path, parts: Any, results: Any) -> None:
    """A worker process: take parts from the queue until None comes, or until the command is gone."""
    import torch

    torch.set_num_threads(1)
    leave_with_command()
    own_progress_lock()
    silence_libraries()
    try:
        recorder = PartRecorder(config, folder)
        while (part := parts.get()) is not None:
            recorder.record(part, results.put)
            results.put(part.index)
    except (ValueError, OSError) as error:
        results.put(error)
    except Exception as error:
        results.put(error)
        raise
