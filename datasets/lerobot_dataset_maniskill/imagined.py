"""A policy's imagined episodes: a part is imagined in one batch, and written like simulated episodes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import DatasetPart, EpisodePlan
from lerobot_dataset_maniskill.worker import EpisodeResult, Report, out_of_range, whole_part
from lerobot_dataset_maniskill.writer import StartColumns, StepResult, add_step
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.exploration import ExplorationNoise
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.policy_checks import fit_to_environment
from lerobot_wmrl.data.dataset import save_episode
from lerobot_wmrl.envs.evaluation_adapter import images_to_numpy
from lerobot_wmrl.envs.start_frames import maniskill_side
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, ACTION_NAMES, STATE_NAMES, TRANSLATION
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.tasks import task_of

Row = tuple[Frame, np.ndarray, StepResult]

VISIT_SEEDS: Final = 10_000_000
"""Random seeds of one visit of all starts, more than a start's own seed can be."""


class ImaginedPartRecorder:
    """Records parts one after the other, with one world model and one policy."""

    def __init__(self, config: RecordConfig, folder: Path) -> None:
        assert config.imagination is not None
        assert config.policy is not None
        self.config, self.folder, self.done_frames = config, folder, config.imagination.done_frames
        self.env: Any = config.imagination.create_tensor_env(min(config.part_episodes, config.num_episodes))
        shown = {name: tuple(space.shape) for name, space in self.env.single_observation_space.items()}
        path, remedy = config.imagination.world_model_path, "train it on what lerobot-wmrl-record recorded"
        if shown.get(OBS_STATE) != (len(STATE_NAMES),):
            raise FieldError(
                "env.world_model_path",
                path,
                f"does not imagine the recorder's state ({len(STATE_NAMES)} values)",
                remedy,
            )
        self.cameras = self.env.model.config.tokenizer.cameras
        self.side = maniskill_side(self.env.model.config.tokenizer, "env.world_model_path", path, remedy)
        fit_to_environment(config.policy, shown, len(ACTION_NAMES))
        self.policy = LoadedPolicy.load(config.policy)
        self.env.model.check_units(config.policy, self.policy.postprocessor)

    def record(self, part: DatasetPart, report: Report) -> None:
        """Record a part. Its folder appears under its final name only when it is whole."""
        with whole_part(self.config, self.folder, part, self.cameras, self.side) as dataset:
            for plan, (instruction, rows, clipped) in zip(
                part.episodes, self._imagine(part.episodes), strict=True
            ):
                start = StartColumns(instruction, task_of(plan.task).index, plan)
                for before, action, result in rows:
                    add_step(dataset, start, before, action, result)
                save_episode(dataset)
                report(EpisodeResult(plan.kind, not rows[-1][-1].truncated, clipped))

    @torch.no_grad()
    def _imagine(self, plans: Sequence[EpisodePlan]) -> list[tuple[str, list[Row], list[float]]]:
        """Return each episode's instruction, rows to the k-frame done or the horizon, and clipped shares."""
        count = self.env.num_envs
        largest = self.config.exploration
        noises = [ExplorationNoise(largest, plan.seed, TRANSLATION, plan.visit) for plan in plans]
        torch.manual_seed(plans[0].seed + VISIT_SEEDS * plans[0].visit)
        self.policy.reset()
        spare = [0] * (count - len(plans))
        observation, _ = self.env.reset(seed=[*(plan.start for plan in plans), *spare])
        instructions = list(observation["task"])
        before = self._frames(observation, torch.zeros(count))
        rows: list[list[Row]] = [[] for _ in plans]
        clipped: list[list[float]] = [[] for _ in plans]
        running = set(range(len(plans)))
        while running:
            action, shares = self._act(observation, noises)
            observation, reward, terminated, truncated, info = self.env.step(torch.from_numpy(action))
            after = self._frames(info.get("final_obs", observation), reward)
            for index in running:
                result = StepResult(after[index], bool(truncated[index]))
                rows[index].append((before[index], action[index], result))
                clipped[index].append(shares[index])
            running -= set((terminated | truncated).nonzero().flatten().tolist())
            before = after
        ended = [with_success(each, self.done_frames) for each in rows]
        return list(zip(instructions, ended, clipped, strict=False))

    def _act(
        self, observation: dict[str, Any], noises: list[ExplorationNoise]
    ) -> tuple[np.ndarray, list[float]]:
        """Return actions (B, 7) inside the action box, and the shares of the policy's that were not (B,)."""
        actions = self.policy.act(observation).cpu().float()
        shares, action = out_of_range(actions), actions.numpy()
        action[: len(noises), :3] += np.stack([noise() for noise in noises])
        return np.clip(action, ACTION_LOW, ACTION_HIGH).astype(np.float32), shares

    def _frames(self, observation: dict[str, Any], reward: Tensor) -> list[Frame]:
        """Return what each environment shows, in the simulator's form, as if it were no success."""
        images = images_to_numpy(observation)
        state = observation[OBS_STATE].cpu().numpy()
        return [
            Frame(
                {camera: frames[index] for camera, frames in images.items()},
                {},
                state[index],
                float(reward[index]),
                False,
            )
            for index in range(len(state))
        ]


def with_success(rows: list[Row], done_frames: int) -> list[Row]:
    """Mark the frames that made an episode's success: its last `done_frames`, unless it was truncated.

    Single frames that were done without being followed by as many others are no success, as in the
    environment.
    """
    if rows[-1][-1].truncated:
        return rows
    solved = [
        (before, action, replace(result, frame=replace(result.frame, success=True)))
        for before, action, result in rows[-done_frames:]
    ]
    return [*rows[:-done_frames], *solved]
