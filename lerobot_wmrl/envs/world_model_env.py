"""The world model as a natively batched environment: many imagined episodes, one forward pass a step."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from lerobot.rewards.factory import make_reward_model
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW, FPS
from lerobot_wmrl.data.compatibility import check_same_tokenizer
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.first_frames import FirstFrames, read_first_frames
from lerobot_wmrl.envs.start_frames import Goals, Starts, load_starts
from lerobot_wmrl.envs.uncertainty import entropies
from lerobot_wmrl.rewards.configuration_general import GeneralConfig
from lerobot_wmrl.rewards.general import consecutive_count, sparse_reward
from lerobot_wmrl.rewards.loading import Reward, load_reward
from lerobot_wmrl.rewards.similarity import Similarity, make_similarity, of_rows
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.frame_tokenizer import Decoded
from lerobot_wmrl.world_models.imagination import Imagined
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)
from lerobot_wmrl.world_models.past import restart_after, start_after

Observation = dict[str, Any]


class WorldModelVectorEnv(gym.vector.VectorEnv):
    """Tensors in, tensors out, SAME_STEP autoreset with `final_obs` and `final_info`.

    A step asks the device one thing, whether an episode has ended and every action was a number: `final_obs`
    is there only where one has, and to begin again costs too much to do it for nobody. Only then the
    instructions of new episodes are fetched.

    Observations: `observation.images.<camera>` (B, 3, H, W) in [0, 1], `observation.state` (B, P) if the
    model predicts it, `task` (B strings). Actions (B, A) in metres, radians and gripper, clipped to the box;
    NaN is refused.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_fps": FPS, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self, model: ActionWorldModelRewardModel, starts: Starts, goals: Goals | None,
        reward: Reward, config: WorldModelEnv, n_envs: int,
    ) -> None:  # fmt: skip
        self.model, self.starts, self.goals = model, starts, goals
        self.reward, self.config = reward, config
        self.num_envs, self.max_episode_steps = n_envs, config.episode_length
        self.device = starts.images.device
        self.action_low, self.action_high = (
            torch.tensor(bound, device=self.device) for bound in (ACTION_LOW, ACTION_HIGH)
        )
        self.single_action_space = gym.spaces.Box(
            self.action_low.cpu().numpy(), self.action_high.cpu().numpy()
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n_envs)
        self.single_observation_space = self._observation_space()
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n_envs)
        self.generator = torch.Generator(self.device)
        self.generator.seed()

    def _observation_space(self) -> gym.spaces.Dict:
        size, config = self.model.config.image_size, self.model.config
        spaces: dict[str, gym.Space] = {
            f"{OBS_IMAGES}.{camera}": gym.spaces.Box(0.0, 1.0, (3, size, size), np.float32)
            for camera in config.cameras
        }
        if config.state_size:
            spaces[OBS_STATE] = gym.spaces.Box(-np.inf, np.inf, (config.state_size,), np.float32)
        return gym.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin B episodes. An int seeds the draw of starts; B of them name each environment's start.

        ValueError for another number of seeds.
        """
        drawn = self._seeded_starts(seed)
        self._begin_at(drawn)
        starts, now = self.starts, self.starts.now[drawn]
        self._imagination = start_after(self.model, starts.past[drawn], now, starts.context[drawn])
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._done_streak = torch.zeros_like(self._elapsed)
        if self.goals is not None:
            self._similarity = self.goals.similarity[drawn]
        return self._observe(self.starts.images[drawn], now.proprioception), {}

    @torch.no_grad()
    def step(self, actions: Tensor) -> tuple[Observation, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Imagine one frame in every environment; finished ones restart at once.

        ValueError unless there is an action for each, without NaN; a reset comes next then.
        """
        clipped = self._clip(actions)
        imagined = self.model.step(self._imagination, clipped, self.generator)
        uncertainty = entropies(imagined)
        terminated, truncated = self._advance(imagined, uncertainty)
        decoded = self.model.decode(imagined.tokens, self._imagination.context)
        observation = self._observe(decoded.images, imagined.proprioception)
        parts = {"success": terminated.float(), **self._progress(decoded)}
        reward = self.reward.compute_reward({**observation, **parts, "hidden": imagined.hidden})
        reward = self.config.uncertainty.weigh(reward, uncertainty)
        parts |= {**uncertainty, "done_probability": imagined.done_logit.sigmoid()}
        info: dict[str, Any] = {"reward_parts": parts}
        finished = terminated | truncated
        any_finished, any_nan = torch.stack([finished.any(), clipped.isnan().any()]).tolist()
        if any_nan:
            rows = clipped.isnan().any(1).nonzero().flatten().tolist()
            raise ValueError(f"action: NaN in environments {rows}; nothing can be imagined after it")
        if any_finished:
            info["final_obs"] = observation
            info["final_info"] = {"is_success": terminated, "episode_length": self._elapsed.clone()}
            observation = self._restart(finished, observation)
        return observation, reward, terminated, truncated, info

    def adopt(self, model: ActionWorldModelRewardModel) -> None:
        """Imagine with a refreshed model from the next reset on. ValueError if starts and goals mean nothing
        to it: they are in the tokens of the first one."""
        check_same_tokenizer(self.model, model, "the refreshed world model")
        self.model = model

    def _advance(self, imagined: Imagined, uncertainty: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Count frames; terminated after k consecutive done frames, truncated at the horizon or if uncertain.
        → (B,), (B,)"""
        fired = sparse_reward(imagined.done_logit, self.config.done_threshold) > 0
        self._done_streak = consecutive_count(self._done_streak, fired)
        self._elapsed = self._elapsed + 1
        uncertain = self.config.uncertainty.ends(uncertainty)
        terminated = (self._done_streak >= self.config.done_frames) & ~uncertain
        return terminated, ((self._elapsed >= self.max_episode_steps) | uncertain) & ~terminated

    def _restart(self, mask: Tensor, observation: Observation) -> Observation:
        """New starts where `mask` (B,) is True; other rows of the observation stay."""
        self._begin_at(torch.where(mask, self._draw_starts(), self._start_index))
        index, starts = self._start_index, self.starts
        past, now, context = starts.past[index], starts.now[index], starts.context[index]
        restart_after(self.model, self._imagination, mask, past, now, context)
        self._elapsed = self._elapsed.masked_fill(mask, 0)
        self._done_streak = self._done_streak.masked_fill(mask, 0)
        if self.goals is not None:
            closeness = self.goals.similarity[index]
            self._similarity = torch.where(mask, closeness, self._similarity)
        fresh = self._observe(starts.images[index], now.proprioception)
        for key, value in observation.items():
            if isinstance(value, Tensor):
                fresh[key] = torch.where(mask.reshape(-1, *[1] * (value.ndim - 1)), fresh[key], value)
        return fresh

    def _begin_at(self, index: Tensor) -> None:
        """Which start every environment's episode has, (B,); the instructions are then known to the host."""
        self._start_index = index
        self._instructions = [self.starts.instructions[row] for row in index.tolist()]

    def _clip(self, actions: Tensor) -> Tensor:
        """To the action box, float32 on the device. ValueError for another shape than (B, A)."""
        if tuple(actions.shape) != self.action_space.shape:
            raise ValueError(
                f"action: shape {tuple(actions.shape)}, but {self.num_envs} environments take "
                f"{self.action_space.shape}"
            )
        given = torch.as_tensor(actions, dtype=torch.float32, device=self.device)
        return given.clamp(self.action_low, self.action_high)

    def _seeded_starts(self, seed: int | Sequence[int] | None) -> Tensor:
        """Seed the generator, by the first of several seeds. → (B,)"""
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
        """How near to their goals the frames are, and the ones before were; nothing without goals."""
        if self.goals is None:
            return {}
        cameras, before = self.model.tokenizer.num_cameras, self._similarity
        described, wanted = self.goals.alike.describe(frame), self.goals.described
        self._similarity = self.goals.alike(described, of_rows(wanted, self._start_index, cameras), cameras)
        return {
            "similarity": self._similarity,
            "previous.similarity": before,
            "goal_reached": self.goals.reached[self._start_index],
        }

    def _observe(self, images: Tensor, state: Tensor) -> Observation:
        observation: Observation = {
            f"{OBS_IMAGES}.{camera}": images[:, index]
            for index, camera in enumerate(self.model.config.cameras)
        }
        if self.model.config.state_size:
            observation[OBS_STATE] = state
        observation["task"] = list(self._instructions)
        return observation


class WorldModels(NamedTuple):
    """What environments of one configuration share: both world models, and how similarity to a goal is
    measured and paid."""

    model: ActionWorldModelRewardModel
    text_model: TextWorldModelRewardModel | None
    alike: Similarity
    reward: Reward


def load_world_models(config: WorldModelEnv, device: str | None) -> WorldModels:
    """ValueError says which of them is not there or does not fit."""
    model = load_model(config.world_model_path, "action_world_model", device)
    if model.config.action_size != len(ACTION_LOW):
        raise ValueError(
            f"--env.world_model_path={config.world_model_path}: was trained on {model.config.action_size} "
            f"action components; the action box has {len(ACTION_LOW)}, so record with lerobot-wmrl-record"
        )
    text_model = None
    if config.text_world_model_path:
        text_model = load_model(config.text_world_model_path, "text_world_model", device)
        check_same_tokenizer(model, text_model, f"--env.text_world_model_path={config.text_world_model_path}")
    alike = make_similarity(getattr(config.reward, "similarity", "tokenizer"), model.state_mean.device)
    return WorldModels(model, text_model, alike, load_reward(config.reward, model))


def make_world_model_env(config: WorldModelEnv, n_envs: int, device: str | None) -> WorldModelVectorEnv:
    """One environment for all start frames."""
    models = load_world_models(config, device)
    return begin_in(read_first_frames(config.dataset, models.model.config), models, config, n_envs)


def make_task_envs(config: WorldModelEnv, n_envs: int, device: str | None) -> dict[int, WorldModelVectorEnv]:
    """One environment for each task among the start frames, by its index; one in all if they do not say."""
    models = load_world_models(config, device)
    frames = read_first_frames(config.dataset, models.model.config)
    tasks = np.unique(frames.tasks).tolist()
    return {max(task, 0): begin_in(frames.of_task(task), models, config, n_envs) for task in tasks}


def begin_in(
    frames: FirstFrames, models: WorldModels, config: WorldModelEnv, n_envs: int
) -> WorldModelVectorEnv:
    """An environment whose episodes begin in these frames."""
    starts, goals = load_starts(frames, models.model, models.text_model, models.alike)
    return WorldModelVectorEnv(models.model, starts, goals, models.reward, config, n_envs)


def success_env(env: WorldModelVectorEnv, source: StartFrames) -> WorldModelVectorEnv:
    """The same world model, and as many imaginations, from other starts: to count successes, so its reward is
    success and there are no goals."""
    reward = make_reward_model(GeneralConfig(alpha=1.0, device=env.device.type))
    models = WorldModels(env.model, None, make_similarity("tokenizer", env.device), reward)
    return begin_in(read_first_frames(source, env.model.config), models, env.config, env.num_envs)
