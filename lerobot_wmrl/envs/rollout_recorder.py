"""A policy's rollouts in any environment of LeRobot's, as LeRobotDatasets."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import ACTION, OBS_IMAGE, TRUNCATED
from lerobot.utils.random_utils import seeded_context
from torch import Tensor

from lerobot_wmrl.common.actions import clip_actions, warn_of_clipped
from lerobot_wmrl.common.constants import KINDS, POLICY, START_KIND, START_SEED, Observation
from lerobot_wmrl.common.errors import FieldError, first_line, renamed
from lerobot_wmrl.common.exploration import ExplorationNoise
from lerobot_wmrl.common.files import whole_folder
from lerobot_wmrl.common.images import to_bytes
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.data.dataset import save_episode
from lerobot_wmrl.data.embodiment import (
    Embodiment,
    component_names,
    observed_range,
    read_embodiment,
    recorded_range,
)
from lerobot_wmrl.data.features import encoder_of, episode_features, matched, observation_row, row_in
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
from lerobot_wmrl.envs.lerobot_env import FRAME_LIMIT, check_fit_to, counts_resets, freeze_finished
from lerobot_wmrl.envs.world_recording import World

IMAGE_WRITERS = 4
"""Threads that compress the frames of rollouts in a LeRobot environment."""


class RolloutRecorder:
    """A policy in an environment of LeRobot's, whose episodes become LeRobotDatasets.

    Args:
        env: the environment; if it has several tasks, they take turns.
        policy: configuration of the policy.
        robot: names and range of the actions, and names of the state; None for what `like` or the
            environment says.
        exploration: largest noise on the actions, as a share of half their range.
        like: metadata of a dataset of the same robot.
        like_columns: take its columns too, so that the new one can be merged with it.
        num_envs: episodes at once.
        video: store the cameras as videos; without `like`, which decides it.
        max_frames: limit of an episode, if the environment's own limit is not lower.
    """

    def __init__(
        self,
        env: EnvConfig,
        policy: PreTrainedConfig,
        robot: Embodiment | None,
        exploration: float = 0.0,
        like: Any | None = None,
        num_envs: int = 1,
        video: bool = False,
        like_columns: bool = True,
        max_frames: int | None = None,
    ) -> None:
        self.config, self.exploration, self.video = env, exploration, video
        self.columns = like.features if like is not None and like_columns else None
        self.robot_type = like.robot_type if like is not None else None
        check_fit_to(env, policy)
        self.policy = LoadedPolicy.load(policy)
        self.env_processors = make_env_pre_post_processors(env, policy)
        self.envs = environments(env, num_envs)
        if max_frames is not None:
            for each in self.envs:
                each.set_attr(FRAME_LIMIT, min(max_frames, each.get_attr(FRAME_LIMIT)[0]))
        for each in self.envs:
            freeze_finished(each)
        self.world = (
            World.of(env, self.envs[0], self.policy, like if like_columns else None)
            if isinstance(env, WorldModelEnv)
            else None
        )
        self.robot = robot or (self.world.robot if self.world else robot_of(env, self.envs[0], like))
        self.envs = [SuccessOfAll(each) for each in self.envs]
        self.range_is_guessed = robot is None and like is None and self.world is None
        try:
            self.encoder = encoder_of(self.columns or {})
        except ValueError as error:  # LeRobot reads more codecs than it writes
            assert like is not None, "columns are those of `like`"
            raise FieldError(
                "like.root",
                like.root,
                f"its videos cannot be encoded alike ({first_line(error)})",
                "give `like_columns=false` if nothing is to be merged",
            ) from error
        if like is not None and like_columns and like.fps != env.fps:
            raise FieldError(
                "like.root",
                like.root,
                f"has {like.fps} frames a second, the environment {env.fps}",
                "give a dataset of the same rate, or `like_columns=false` if nothing is to be merged",
            )

    def close(self) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()

    def record(self, folder: Path, seeds: Sequence[int], report: Callable[[bool], None]) -> None:
        """Record a dataset in `folder`, which appears when it is whole: one episode from each seed.

        Where the environment has several tasks, consecutive seeds belong to different ones; the dataset has
        the episodes of one task after those of another.

        report: is told of every episode whether it succeeds.
        """
        dataset, clipped = None, list[float]()
        with whole_folder(folder) as partial:
            for env, chosen in self._batches(seeds):
                recording, taken = self._roll_out(env, chosen)
                dataset = dataset or self._create(partial, recording.observations[0])
                for row, seed in enumerate(chosen):
                    length = int(taken["done"][row].int().argmax()) + 1
                    report(self._add_episode(dataset, recording, taken, row, seed, length))
                    clipped += [float(shares[row]) for shares in recording.clipped[:length]]
            assert dataset is not None, "there is no seed"
            dataset.finalize()
        warn_of_clipped(clipped)
        if any(clipped) and self.range_is_guessed:
            logging.warning(
                "the range is that of the action space of %s; if the environment takes more, record again "
                "with `like.root`, a dataset of the same robot whose actions show it",
                self.config.type,
            )

    def skip(self, seeds: Sequence[int]) -> None:
        """Pass over the starts of these seeds' episodes, which are recorded already, where resets count."""
        if counts_resets(self.config):
            for env, _ in self._batches(seeds):
                env.reset(options={NEW_ROLLOUT_OPTION: True})

    def _batches(self, seeds: Sequence[int]) -> Iterator[tuple[Any, Sequence[int]]]:
        """Yield the environments of a task, and the seeds of the next episodes in them."""
        for task, env in enumerate(self.envs):
            task_seeds = [seed for seed in seeds if seed % len(self.envs) == task]
            for first in range(0, len(task_seeds), env.num_envs):
                yield env, task_seeds[first : first + env.num_envs]

    def _roll_out(self, env: Any, seeds: Sequence[int]) -> tuple["RecordingProcessors", dict[str, Tensor]]:
        """Return what the policy saw and did from these seeds, and LeRobot's record of the outcome."""
        spare = [seeds[-1]] * (env.num_envs - len(seeds))
        noises = [ExplorationNoise(self.exploration, seed, self._scale()) for seed in [*seeds, *spare]]
        recording = RecordingProcessors(*self.policy.processors, noises, self.robot)
        with seeded_context(seeds[0]):  # of a policy that draws its actions, as flows and diffusion do
            taken = rollout(
                env,
                self.policy.policy,
                *self.env_processors,
                recording.preprocess,
                recording.postprocess,
                seeds=[*seeds, *spare],
            )
        return recording, taken

    def _scale(self) -> np.ndarray:
        scale = (np.array(self.robot.action_high) - np.array(self.robot.action_low)) / 2
        return scale if self.world is None else np.where(self.world.varied, scale, 0.0)

    def _create(self, folder: Path, observation: Observation) -> LeRobotDataset:
        """Create an empty dataset for what this observation shows."""
        whole = {"dtype": "int64", "shape": (1,), "names": None}
        recorded = {
            **episode_features(observation, self.robot, "video" if self.video else "image"),
            **(self.world.features() if self.world else {}),
            START_SEED: whole,
            START_KIND: whole,
        }
        features = recorded if self.columns is None else matched(recorded, self.columns)
        return LeRobotDataset.create(
            f"local/{folder.name.strip('.')}",
            self.config.fps,
            features,
            root=folder,
            robot_type=self.robot_type,
            rgb_encoder=self.encoder,
            use_videos=any(feature["dtype"] == "video" for feature in features.values()),
            image_writer_threads=IMAGE_WRITERS,
        )

    def _add_episode(
        self,
        dataset: LeRobotDataset,
        recording: "RecordingProcessors",
        taken: dict[str, Tensor],
        row: int,
        seed: int,
        length: int,
    ) -> bool:
        """Add the episode of one environment of a rollout. Return whether it succeeds."""
        success = bool(taken["success"][row, length - 1])
        labelled = "next.success" in dataset.features  # else next.done is taken for it
        hold = self.world.done_frames if self.world else 1
        begun = {START_SEED: np.array([seed]), **(self.world.begun(seed) if self.world else {})}
        for step in range(length):
            observation = recording.observations[step]
            frame: dict[str, Any] = observation_row(observation, row)
            solved = bool(taken["success"][row, step]) or (success and step >= length - hold)
            frame |= {
                ACTION: recording.actions[step][row],
                "next.reward": np.array([float(taken["reward"][row, step])], np.float32),
                "next.success": np.array([solved]),
                "next.done": np.array([step == length - 1 if labelled else solved]),
                TRUNCATED: np.array([step == length - 1 and not success]),  # a column in world models alone
                **begun,
                START_KIND: np.array([KINDS.index(POLICY)]),
            }
            kept = row_in(dataset.features, frame)
            dataset.add_frame({**kept, "task": (observation.get("task") or [""])[row]})
        save_episode(dataset)
        return success


def environments(config: EnvConfig, count: int) -> list[Any]:
    """Make `count` copies of an environment, one vector environment a task; of a world model one for all of
    its starts, whatever their tasks."""
    if isinstance(config, WorldModelEnv):
        return [EvaluationAdapter(config.create_tensor_env(count))]
    made = make_env(config, count, use_async_envs=False)
    return [each for tasks in made.values() for each in tasks.values()]


class SuccessOfAll(gym.vector.VectorWrapper):
    """Says of every environment whether it has succeeded, also where others end in the same step.

    LeRobot's rollout then looks at the episodes that end alone (`final_info`), and takes all others for
    unsolved.
    """

    def __getattr__(self, name: str) -> Any:
        """Return what LeRobot asks a vector environment for beside its interface, such as `call`."""
        return getattr(self.env, name)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take a step in all environments."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        final = info.get("final_info")
        if isinstance(final, dict) and "is_success" in info:
            ended, at_end = terminated | truncated, final.get("is_success", np.zeros(self.num_envs, bool))
            info["final_info"] = {**final, "is_success": np.where(ended, at_end, info["is_success"])}
        return observation, reward, terminated, truncated, info


def robot_of(config: EnvConfig, env: Any, like: Any | None) -> Embodiment:
    """Return the robot of an environment.

    Args:
        config: the environment's.
        env: the environment.
        like: metadata of a dataset of the same robot, whose names are taken, and whose range if it states
            one. Else the range is that of the environment's action space, widened to that of the actions in
            `like`: an environment may take more than its space says, as LeRobot's Aloha does (joint angles,
            "from -1 to 1"). Without `like`, numbers are the names.

    Raises:
        FieldError: the actions of both have other numbers of components, or neither says how large they are.
    """
    space = env.single_action_space
    low, high = np.asarray(space.low, float).tolist(), np.asarray(space.high, float).tolist()
    bounded = bool(np.isfinite([low, high]).all())
    if like is not None:
        count = int(np.prod(like.features[ACTION]["shape"]))
        if count != len(low):
            raise FieldError(
                "like.root",
                like.root,
                f"its actions have {count} components, the environment's {len(low)}",
                "give a dataset of the same robot",
            )
        embodiment = Embodiment()
        with renamed("dataset.root", "like.root"):
            if recorded_range(like.features[ACTION]) is None and bounded:
                embodiment = widened(config, low, high, like)
            return read_embodiment(like, embodiment)
    if not bounded:
        raise FieldError(
            "env.type",
            config.type,
            "does not say between which values its actions are",
            "give a dataset of the same robot, `like.root` or `like.repo_id`",
        )
    return Embodiment(config.fps, [str(index) for index in range(len(low))], low, high)


def widened(config: EnvConfig, low: list[float], high: list[float], like: Any) -> Embodiment:
    """Return the range of an environment's actions, widened to that of a dataset's; warns where it was."""
    least, most = observed_range(like)
    beyond = [
        f"{name} {observed[0]:.4g} to {observed[1]:.4g} (in {config.type} {limits[0]:.4g} to {limits[1]:.4g})"
        for name, limits, observed in zip(
            component_names(like.features[ACTION]),
            zip(low, high, strict=True),
            zip(least, most, strict=True),
            strict=True,
        )
        if observed[0] < limits[0] or observed[1] > limits[1]
    ]
    if beyond:
        logging.warning(
            "like.root: actions go beyond the environment's action space, and so may the policy's: %s. Are "
            "they in the same units?",
            ", ".join(beyond),
        )
    return Embodiment(action_low=np.minimum(low, least).tolist(), action_high=np.maximum(high, most).tolist())


@dataclass
class RecordingProcessors:
    """Wrap a policy's processors: keep observations and actions, and add exploration noise to the actions.

    Args:
        before, after: the policy's pre- and postprocessor.
        noises: what is added to the actions, one for each environment.
        robot: robot whose range the actions keep.
    """

    before: Any
    after: Any
    noises: Sequence[ExplorationNoise]
    robot: Embodiment
    observations: list[Observation] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    clipped: list[Tensor] = field(default_factory=list)
    """Of each step, the share of the components of the policy's actions that were out of range. (B,)"""

    def preprocess(self, observation: Observation) -> Observation:
        """Keep a batch of observations in LeRobot's names, images in uint8, and prepare it for the policy."""
        self.observations.append(
            {
                name: to_bytes(value) if name.startswith(OBS_IMAGE) else value
                for name, value in observation.items()
            }
        )
        prepared: Observation = self.before(observation)
        return prepared

    def postprocess(self, action: Tensor) -> Tensor:
        """Return the policy's actions in the dataset's units, with noise, within their range. (B, A)"""
        low, high = torch.tensor(self.robot.action_low), torch.tensor(self.robot.action_high)
        chosen = self.after(action).cpu().float()
        self.clipped.append(clip_actions(chosen, low, high)[1])
        noise = torch.from_numpy(np.stack([noise() for noise in self.noises])).float()
        kept = (chosen + noise).clamp(low, high)
        self.actions.append(kept.numpy())
        return kept
