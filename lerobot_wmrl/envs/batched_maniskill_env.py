"""ManiSkill as one batch on CUDA, behind the tensor interface that the world model has too."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.maniskill_env import image_observations, observation_space
from lerobot_wmrl.envs.scene_results import SceneResults
from lerobot_wmrl.envs.tensor_env import Outcome, TensorEnv
from lerobot_wmrl.maniskill.batched import BatchedFrame
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, FPS
from lerobot_wmrl.maniskill.scenes import scene_for_seed


class BatchedManiSkillEnv(TensorEnv):
    """B episodes in one simulation, with the observations and results of `ManiSkillTensorEnv`.

    Args:
        restart: whether an ended episode is followed by the next at once (SAME_STEP autoreset, with
            `final_obs` and `final_info`). Otherwise its table is left alone until all are reset, and closing
            logs the success by scene, as lerobot-eval needs it.
    """

    metadata = {"render_fps": FPS, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 (gymnasium's own)

    def __init__(self, config: WmrlManiSkillEnv, n_envs: int, device: str, restart: bool) -> None:
        self.config, self.num_envs, self.restart = config, n_envs, restart
        self.scenes, self.results = config.selected_scenes(), SceneResults(str(config.task))
        self.simulation = config.create_batched_simulation(n_envs, device)
        self.device, self.max_episode_steps = self.simulation.device, config.horizon
        self._elapsed = torch.zeros(n_envs, dtype=torch.long, device=self.device)
        self._progress = torch.zeros(n_envs, device=self.device)
        self.action_low, self.action_high = (
            torch.tensor(end, device=self.device) for end in (ACTION_LOW, ACTION_HIGH)
        )
        self._rng = np.random.default_rng()
        self.single_action_space = gym.spaces.Box(
            np.array(ACTION_LOW, np.float32), np.array(ACTION_HIGH, np.float32)
        )
        self.single_observation_space = observation_space(config)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n_envs)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n_envs)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin B episodes: with B seeds, with consecutive ones from an int on, or with training seeds."""
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_envs)
        if seed is not None:
            self._rng = np.random.default_rng(seed[0])
        frame = self._begin(self._draw_seeds(self.num_envs) if seed is None else seed, range(self.num_envs))
        return self._observation(frame), {}

    def _advance(self, actions: Tensor) -> Outcome:
        """Simulate one control step of every episode. actions (B, 7)"""
        frame = self.simulation.step(actions)
        self._elapsed += 1
        terminated = frame.success
        truncated = (self._elapsed >= self.max_episode_steps) & ~terminated
        reward = self.config.reward.step_reward(
            terminated.float(), frame.reward, self._progress, self.max_episode_steps
        )
        self._progress = frame.reward
        return Outcome(
            self._observation(frame), reward, terminated, truncated, terminated, self._elapsed.clone()
        )

    def _restart(self, ended: Tensor, outcome: Outcome) -> Observation:
        if not self.restart:
            self._count(ended, outcome.success)
            return outcome.observation
        rows = ended.nonzero()[:, 0].tolist()
        return self._observation(self._begin(self._draw_seeds(len(rows)), rows))

    def close_extras(self, **kwargs: Any) -> None:
        self.simulation.close()
        self.results.log()

    def _draw_seeds(self, count: int) -> list[int]:
        """Draw training seeds."""
        return [int(seed) for seed in self._rng.integers(EVALUATION_SEED, size=count)]

    def _begin(self, seeds: Sequence[int], rows: Sequence[int]) -> BatchedFrame:
        """Begin new episodes in these rows."""
        self._elapsed[list(rows)] = 0
        scenes = [scene_for_seed(self.scenes, seed) for seed in seeds]
        frame = self.simulation.reset(scenes, seeds, rows)
        self._progress = frame.reward
        return frame

    def _count(self, ended: Tensor, succeeded: Tensor) -> None:
        episodes = self.simulation.episodes
        columns = {
            "seed": np.array([episode.seed for episode in episodes]),
            "scene": np.array([episode.scene.index for episode in episodes]),
            "is_success": succeeded.cpu().numpy(),
        }
        self.results.add(columns, ended.cpu().numpy())

    def _observation(self, frame: BatchedFrame) -> dict[str, Any]:
        instructions = [episode.start.instruction for episode in self.simulation.episodes]
        return {**image_observations(frame.images), OBS_STATE: frame.state, "task": instructions}
