"""The world model as a natively batched environment: many imagined episodes, one forward pass a step."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from lerobot.rewards.factory import make_reward_model
from lerobot.utils.constants import OBS_STATE
from torch import Tensor
from torch.distributions import Bernoulli

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.statistics import evenly_spaced
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.start_frames import StartImages, read_start_images
from lerobot_wmrl.envs.starts import GoalFeatures, Starts, load_starts
from lerobot_wmrl.envs.tensor_env import Outcome, TensorEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import consecutive_count, is_done
from lerobot_wmrl.rewards.loading import LeRobotReward, Reward, load_reward
from lerobot_wmrl.rewards.similarity import Similarity, make_similarity
from lerobot_wmrl.world_models.checkpoint import check_same_tokenizer, load_model
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.dynamics import Imagined
from lerobot_wmrl.world_models.frame_tokenizer import Decoded
from lerobot_wmrl.world_models.goal import select_features
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)


class WorldModelVectorEnv(TensorEnv):
    """B imagined episodes.

    Images have the size of the dataset's frames, and there is a state if the model predicts it.

    A step synchronises with the device once, to learn whether an episode has ended and whether every action
    was a number. Resets are expensive, so they run only when an episode has ended, and only then the
    instructions of new episodes are fetched.
    """

    refuses_nan_first = False

    def __init__(
        self,
        model: ActionWorldModelRewardModel,
        starts: Starts,
        goals: GoalFeatures | None,
        reward: Reward,
        config: WorldModelEnv,
        n_envs: int,
    ) -> None:
        self.model, self.starts, self.goals = model, starts, goals
        self.reward, self.config = reward, config
        self.num_envs, self.max_episode_steps = n_envs, config.horizon
        self.device, self._compact = starts.images.device, False
        embodiment = model.config.embodiment
        self.metadata = {"render_fps": embodiment.fps, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.action_low, self.action_high = model.action_range()
        self.single_action_space = gym.spaces.Box(
            self.action_low.cpu().numpy(), self.action_high.cpu().numpy()
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n_envs)
        self.generator = torch.Generator(self.device)
        self.generator.seed()

    @cached_property
    def observation_space(self) -> gym.Space[Any]:
        """What all environments show. Training does not read it: its bounds take as much memory as frames."""
        return gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def single_observation_space(self) -> gym.spaces.Dict:
        """What one environment shows."""

        def box(key: str, shape: tuple[int, ...]) -> gym.spaces.Box:
            low, high = (-np.inf, np.inf) if key == OBS_STATE else (0.0, 1.0)
            return gym.spaces.Box(low, high, shape, np.float32)

        shapes = self.model.config.observation_shapes
        return gym.spaces.Dict({key: box(key, shape) for key, shape in shapes.items()})

    def accept(self, policy: LoadedPolicy) -> None:
        """Raise FieldError if the policy acts in other units than the world model's dataset has."""
        self.model.check_units(policy.config, policy.postprocessor)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin B episodes.

        Args:
            seed: an int seeds the draw of starts; B ints name the start of each environment.

        Raises:
            ValueError: another number of seeds.
        """
        drawn = self._seeded_starts(seed)
        self._begin_at(drawn)
        frames = self.starts.frames[drawn]
        self._imagination = self.model.start(frames)
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._done_streak = torch.zeros_like(self._elapsed)
        if self.goals is not None:
            self._similarity = self.goals.similarity[drawn]
        return self._observe(self.starts.images[drawn], frames.state), {}

    def _advance(self, actions: Tensor) -> Outcome:
        """Imagine one frame in every environment. actions (B, A)"""
        imagined = self.model.step(self._imagination, actions)
        terminated, truncated = self._ends(imagined)
        decoded = self.model.decode(imagined.tokens, self._imagination.context)
        observation = self._observe(decoded.images, imagined.state)
        parts = {"success": terminated.float(), **self._progress(decoded)}
        shown = self.model.shown(observation) if isinstance(self.reward, LeRobotReward) else observation
        reward = self.reward.compute_reward({**shown, **parts, "hidden": imagined.hidden})
        parts |= {**entropies(imagined), "done_probability": imagined.done_logit.sigmoid()}
        return Outcome(observation, reward, terminated, truncated, terminated, self._elapsed, parts)

    def newest_frames(self) -> Frames:
        """Return the newest imagined frames, from which a planner can look ahead."""
        return self.model.newest(self._imagination)

    @torch.no_grad()
    def policy_actions(self, act: Callable[[Observation], Tensor], rows: Tensor, steps: int) -> Tensor:
        """Return what a policy would do from the newest frames of the environments `rows` (R,) on.

        Their episodes do not go on. act: observations of the R environments → actions (R, A).

        Returns:
            (R, steps, A), clipped to their range.
        """
        instructions = [self._instructions[row] for row in rows.tolist()]

        def bounded(images: Tensor, state: Tensor) -> Tensor:
            action = act(self._observe(images, state, instructions)).to(self.device)
            return action.clamp(self.action_low, self.action_high)

        return self.model.policy_actions(self.newest_frames()[rows], bounded, steps)

    def adopt(self, model: ActionWorldModelRewardModel) -> None:
        """Imagine with a refreshed model from the next reset on, frames of the same size.

        Raises:
            ValueError: it has another tokenizer, so that it cannot read the tokens of starts and goals.
        """
        check_same_tokenizer(self.model, model, "world_model_path", "the refreshed one")
        sizes = self.model.config.trained_tokenizer.frame_sizes  # which the policy has learnt from
        model.config.tokenizer = replace(model.config.trained_tokenizer, frame_sizes=sizes)
        self.model = model

    def _ends(self, imagined: Imagined) -> tuple[Tensor, Tensor]:
        """Count frames. Return terminated (k consecutive done frames) and truncated (at the horizon). → (B,)
        bool, (B,) bool"""
        fired = is_done(imagined.done_logit, self.config.done_threshold)
        self._done_streak = consecutive_count(self._done_streak, fired)
        self._elapsed = self._elapsed + 1
        terminated = self._done_streak >= self.config.done_frames
        return terminated, (self._elapsed >= self.max_episode_steps) & ~terminated

    def _restart(self, ended: Tensor, outcome: Outcome) -> Observation:
        """Begin new episodes where `ended` (B,) is True; for the others nothing changes."""
        self._begin_at(torch.where(ended, self._draw_starts(), self._start_index))
        index, starts = self._start_index, self.starts
        frames = starts.frames[index]
        self.model.restart(self._imagination, ended, frames)
        self._elapsed = self._elapsed.masked_fill(ended, 0)
        self._done_streak = self._done_streak.masked_fill(ended, 0)
        if self.goals is not None:
            self._similarity = torch.where(ended, self.goals.similarity[index], self._similarity)
        fresh = self._observe(starts.images[index], frames.state)
        for key, value in outcome.observation.items():
            if isinstance(value, Tensor):
                fresh[key] = torch.where(ended.reshape(-1, *[1] * (value.ndim - 1)), fresh[key], value)
        return fresh

    def _begin_at(self, index: Tensor) -> None:
        """Set the start of every environment's episode, index (B,), and fetch its instruction."""
        self._start_index = index
        self._instructions = [self.starts.instructions[row] for row in index.tolist()]

    def _seeded_starts(self, seed: int | Sequence[int] | None) -> Tensor:
        """Seed the generator (by the first of several seeds) and return the starts. → (B,)"""
        if seed is None:
            return self._draw_starts()
        if isinstance(seed, int | np.integer):
            self.generator.manual_seed(int(seed))
            return self._draw_starts()
        seeds = [int(each) for each in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds for {self.num_envs} environments; give one each")
        self.generator.manual_seed(seeds[0])
        return torch.tensor(seeds, device=self.device) % len(self.starts)

    def _draw_starts(self) -> Tensor:
        return torch.randint(len(self.starts), (self.num_envs,), generator=self.generator, device=self.device)

    def _progress(self, frame: Decoded) -> dict[str, Tensor]:
        """Return the similarity to the goals, now and before this step; nothing without goals. (B,) each"""
        if self.goals is None:
            return {}
        cameras, before = self.model.tokenizer.num_cameras, self._similarity
        goals = select_features(self.goals.features, self._start_index, cameras)
        self._similarity = self.goals.measure(self.goals.measure.features(frame), goals, cameras)
        return {
            "similarity": self._similarity,
            "previous.similarity": before,
            "goal_reached": self.goals.reached[self._start_index],
        }

    def store_compact(self) -> Callable[[Observation], Observation]:
        """Show squares in place of frames of the dataset's size, which may be much larger to store, from now
        on; return what makes such an observation what a policy sees."""
        self._compact = True
        return lambda observation: self.model.shown(observation)  # of the model that Dyna may have refreshed

    def _observe(
        self, images: Tensor, state: Tensor, instructions: Sequence[str] | None = None
    ) -> Observation:
        made = self.model.compact_observation if self._compact else self.model.observation
        return made(images, state, self._instructions if instructions is None else instructions)


class WorldModels(NamedTuple):
    """What the environments of one configuration share: both world models, the measure of similarity to a
    goal frame, and the reward."""

    model: ActionWorldModelRewardModel
    text_model: TextWorldModelRewardModel | None
    measure: Similarity
    reward: Reward


def load_world_models(config: WorldModelEnv, device: str | None) -> WorldModels:
    """Load the models that `config` names. ValueError if one is missing or does not fit the others."""
    model = load_model(config.world_model_path, "action_world_model", device)
    text_model = None
    if config.text_world_model_path:
        text_model = load_model(config.text_world_model_path, "text_world_model", device)
        check_same_tokenizer(model, text_model, "text_world_model_path", config.text_world_model_path)
    measure = make_similarity(getattr(config.reward, "similarity", "tokenizer"), model.device)
    return WorldModels(model, text_model, measure, load_reward(config.reward, model, config.horizon))


def make_world_model_env(config: WorldModelEnv, n_envs: int, device: str | None) -> WorldModelVectorEnv:
    """Return one environment for all start frames."""
    models = load_world_models(config, device)
    warn_of_long_episodes(config, models.model.config)
    return make_env_at(read_start_images(config.dataset, models.model.config), models, config, n_envs)


def warn_of_long_episodes(config: WorldModelEnv, model: ActionWorldModelConfig) -> None:
    """Say so if imagined episodes are longer than anything that the world model has learnt from."""
    if config.horizon > model.clip_length:
        logging.warning(
            "imagined episodes of %d frames are longer than the clips of %d frames that the world model has "
            "learnt from, and less reliable from there on: train it with --model.clip_length=%d, or lower "
            "env.episode_length",
            config.horizon,
            model.clip_length,
            config.horizon,
        )


def make_task_envs(config: WorldModelEnv, n_envs: int, device: str | None) -> dict[int, WorldModelVectorEnv]:
    """Return one environment for each task among the start frames, by its index; one if tasks are unknown."""
    models = load_world_models(config, device)
    frames = read_start_images(config.dataset, models.model.config)
    tasks = np.unique(frames.tasks).tolist()
    return {max(task, 0): make_env_at(frames.of_task(task), models, config, n_envs) for task in tasks}


def make_env_at(
    frames: StartImages, models: WorldModels, config: WorldModelEnv, n_envs: int
) -> WorldModelVectorEnv:
    """Return an environment whose episodes begin in these frames."""
    starts, goals = load_starts(frames, models.model, models.text_model, models.measure)
    return WorldModelVectorEnv(models.model, starts, goals, models.reward, config, n_envs)


def load_spread_starts(model: ActionWorldModelRewardModel, source: StartFrames, at_most: int) -> Starts:
    """Read and tokenise at most so many of the starts that `source` names, spread evenly."""
    frames = read_start_images(source, model.config)
    frames = frames.chosen(evenly_spaced(len(frames.images), at_most))
    return load_starts(frames, model, None, make_similarity("tokenizer", model.device))[0]


def make_success_env(env: WorldModelVectorEnv, starts: Starts, episodes: int) -> WorldModelVectorEnv:
    """Return an environment that counts successes from other starts: the world model that `env` has now, as
    many imaginations but no more than `episodes`, frames of the dataset's size, success as the reward and no
    goals."""
    reward = make_reward_model(GeneralConfig(alpha=1.0, device=env.device.type))
    return WorldModelVectorEnv(env.model, starts, None, reward, env.config, min(env.num_envs, episodes))


def entropies(imagined: Imagined) -> dict[str, Tensor]:
    """Return how uncertain the model is of each frame's appearance and of its success, in nats. (B,) each"""
    done = Bernoulli(logits=imagined.done_logit, validate_args=False)
    return {"token_entropy": imagined.entropy, "done_entropy": done.entropy()}
