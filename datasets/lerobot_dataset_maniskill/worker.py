"""What a recording process does: choose the actions of its episodes, simulate them, write them.

Actions come from a planner or a policy. Each part becomes a sub-dataset, renamed when it is whole.
"""

import logging
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import av
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import DatasetPart, EpisodePlan
from lerobot_dataset_maniskill.planners import MOTIONS, follow_plan
from lerobot_dataset_maniskill.planners.kinds import PLAY_STEPS
from lerobot_dataset_maniskill.writer import HOLD_FRAMES, StartColumns, StepResult, add_step, create_dataset
from lerobot_wmrl.common.actions import clip_actions
from lerobot_wmrl.common.constants import KINDS, PLAY
from lerobot_wmrl.common.exploration import ExplorationNoise
from lerobot_wmrl.common.images import from_bytes
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.processes import own_progress_lock
from lerobot_wmrl.data.dataset import save_episode
from lerobot_wmrl.maniskill.backend import leave_with_command
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, TRANSLATION
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.tasks import task_of

if TYPE_CHECKING:
    from lerobot_wmrl.maniskill.simulation import Simulation


class Controller(Protocol):
    """Chooses the actions of an episode: (7,) float32, inside the action box."""

    clipped: list[float]
    """Of each step of the episode, the share of the components that were out of the box before any noise."""

    def begin(self, simulation: "Simulation", plan: EpisodePlan) -> None:
        """Prepare for an episode that has just been reset."""

    def act(self, simulation: "Simulation", frame: Frame) -> np.ndarray:
        """Return the action for this frame."""


class ScriptedController:
    """Follows a plan that depends only on the episode's start and kind, with one of `planners.MOTIONS`."""

    def __init__(self, planner: str) -> None:
        self.motion = MOTIONS[planner]()
        self.clipped: list[float] = []  # it plans within the box

    def begin(self, simulation: "Simulation", plan: EpisodePlan) -> None:
        rng = np.random.default_rng((plan.seed, KINDS.index(plan.kind), simulation.task.index))
        episode = simulation.episode
        self.follower = follow_plan(
            simulation.task.name, episode.scene, episode.start, plan.kind, rng, self.motion
        )

    def act(self, simulation: "Simulation", frame: Frame) -> np.ndarray:
        return self.follower.act(simulation.tcp_position, simulation.object_position)


class PolicyController:
    """Acts by a LeRobot policy with its own pre- and postprocessors, and exploration noise on its actions."""

    def __init__(self, config: PreTrainedConfig, exploration: float) -> None:
        self.policy, self.exploration = LoadedPolicy.load(config), exploration
        self.clipped: list[float] = []

    def begin(self, simulation: "Simulation", plan: EpisodePlan) -> None:
        torch.manual_seed(plan.seed)
        self.clipped = []
        self.noise = ExplorationNoise(self.exploration, plan.seed, TRANSLATION)
        self.policy.reset()

    def act(self, simulation: "Simulation", frame: Frame) -> np.ndarray:
        chosen = self.policy.act(policy_observation(frame, simulation.instruction)).cpu().float()
        self.clipped += out_of_range(chosen)
        action = chosen.squeeze(0).numpy()
        action[:3] += self.noise()
        return np.clip(action, ACTION_LOW, ACTION_HIGH).astype(np.float32)


def out_of_range(actions: Tensor) -> list[float]:
    """Return the share of the components of each action (B, 7) that are outside the action box."""
    _, shares = clip_actions(actions, torch.tensor(ACTION_LOW), torch.tensor(ACTION_HIGH))
    return shares.tolist()


def policy_observation(frame: Frame, instruction: str) -> dict[str, Any]:
    """Return a batch of one in LeRobot's names: images (1, 3, H, W) in [0, 1], state (1, 8), task."""
    images = {
        f"observation.images.{camera}": from_bytes(torch.from_numpy(image).permute(2, 0, 1)[None])
        for camera, image in frame.images.items()
    }
    return {**images, "observation.state": torch.from_numpy(frame.state)[None], "task": [instruction]}


@dataclass(frozen=True)
class EpisodeResult:
    """What the command says of an episode.

    Args:
        kind: what it was recorded as.
        success: whether it succeeds.
        clipped: of each step, the share of the components of a policy's action that were out of range;
            nothing where a planner acts.
    """

    kind: str
    success: bool
    clipped: Sequence[float] = ()


Report = Callable[[EpisodeResult], None]


@contextmanager
def whole_part(config: RecordConfig, folder: Path, part: DatasetPart) -> Iterator[LeRobotDataset]:
    """Yield an empty dataset to fill; unless an error is raised, move it to `folder` as the part."""
    env, partial = config.maniskill, folder / f".{part.name}.{os.getpid()}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    dataset = create_dataset(
        partial, config.dataset_id, env.cameras, env.image_size, config.depth, config.video
    )
    yield dataset
    dataset.finalize()
    partial.replace(folder / part.name)


class PartRecorder:
    """Records parts one after the other, with one simulation and one controller."""

    def __init__(self, config: RecordConfig, folder: Path) -> None:
        env = config.maniskill
        self.config, self.folder = config, folder
        self.simulation = env.create_simulation(config.depth)
        self.controller: Controller = (
            ScriptedController(config.planner)
            if config.policy is None
            else PolicyController(config.policy, config.exploration)
        )

    def record(self, part: DatasetPart, report: Report) -> None:
        """Record a part. Its folder appears under its final name only when it is whole."""
        with whole_part(self.config, self.folder, part) as dataset:
            for plan in part.episodes:
                success = self._record_episode(dataset, plan)
                report(EpisodeResult(plan.kind, success, self.controller.clipped))

    def _steps(self, plan: EpisodePlan) -> int:
        """Return the largest number of rows of an episode."""
        if plan.kind == PLAY:
            return PLAY_STEPS
        return self.config.maniskill.episode_length or self.simulation.task.horizon

    def _record_episode(self, dataset: LeRobotDataset, plan: EpisodePlan) -> bool:
        """Simulate and store one episode, to HOLD_FRAMES after success first holds, or to the horizon.

        Play goes on whatever happens.

        Returns:
            Whether the episode succeeded.
        """
        simulation = self.simulation
        simulation.task = task_of(plan.task)
        frame = simulation.reset(plan.scene, plan.seed)
        self.controller.begin(simulation, plan)
        start = StartColumns(simulation.instruction, simulation.task.index, plan)
        steps_left = self._steps(plan)
        succeeded = False
        while steps_left > 0:
            action = self.controller.act(simulation, frame)
            following = simulation.step(action)
            steps_left -= 1
            if following.success and not succeeded and plan.kind != PLAY:
                succeeded, steps_left = True, HOLD_FRAMES
            result = StepResult(following, truncated=steps_left == 0 and not succeeded)
            add_step(dataset, start, frame, action, result)
            frame = following
        save_episode(dataset)
        return succeeded


def serve_parts(config: RecordConfig, folder: Path, parts: Any, results: Any) -> None:
    """Record parts from the queue until None comes, or until the command is gone. Runs in a worker process.

    Args:
        config: configuration of the recording.
        folder: folder for the sub-datasets.
        parts: queue of `DatasetPart`, ended by None.
        results: queue for `EpisodeResult`, the index of each whole part, and errors.
    """
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


def silence_libraries() -> None:
    """Turn off FFmpeg's reports, Hugging Face's progress bars and LeRobot's information messages."""
    av.logging.set_libav_level(av.logging.ERROR)
    logging.getLogger("lerobot").setLevel(logging.ERROR)
