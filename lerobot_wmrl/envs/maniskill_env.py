"""ManiSkill as a gymnasium environment (one robot, numpy), and as the one lerobot-eval drives."""

from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.envs.utils import FreezeAfterEpisodeEnd

from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW, EVALUATION_SEED, FPS, STATE_NAMES
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.scene_results import CountingAsyncVectorEnv, CountingSyncVectorEnv
from lerobot_wmrl.maniskill.backend import simulating_context
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.scenes import scene_for_seed


class ManiSkillEnv(gym.Env):
    """One episode at a time. A seed decides scene and start; the simulator is built at the first reset.

    Observation: `pixels` {camera: (H, W, 3) uint8}, `agent_pos` (8,) float32. Action (7,): metres, radians,
    gripper. Terminated as soon as success holds, truncated at the horizon. A reset without a seed draws a
    training seed.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"

    def __init__(self, config: WmrlManiSkillEnv) -> None:
        self.config = config
        self._scenes = config.selected_scenes()
        self._max_episode_steps = config.horizon
        self.task = str(config.task)
        self.task_description = ""
        picture = gym.spaces.Box(0, 255, (config.image_size, config.image_size, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict(dict.fromkeys(config.cameras, picture)),
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32),
            }
        )
        self.action_space = gym.spaces.Box(
            np.array(ACTION_LOW, np.float32), np.array(ACTION_HIGH, np.float32)
        )
        self._simulation: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(EVALUATION_SEED))
        if self._simulation is None:
            self._simulation = self.config.create_simulation()
        self._scene = scene_for_seed(self._scenes, seed)
        self._seed, self._steps = seed, 0
        self._frame = self._simulation.reset(self._scene, seed)
        self.task_description = self._simulation.instruction
        return self._observation(self._frame), self._info(self._frame)

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self._steps += 1
        before, self._frame = self._frame, self._simulation.step(action)
        terminated = self._frame.success
        truncated = not terminated and self._steps >= self._max_episode_steps
        return (
            self._observation(self._frame),
            self.config.reward.step_reward(float(terminated), self._frame.reward, before.reward),
            terminated,
            truncated,
            self._info(self._frame),
        )

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8, the first camera's picture."""
        return self._frame.images[self.config.cameras[0]]

    def close(self) -> None:
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _observation(self, frame: Frame) -> dict[str, Any]:
        return {"pixels": dict(frame.images), "agent_pos": frame.state}

    def _info(self, frame: Frame) -> dict[str, Any]:
        return {
            "is_success": frame.success,
            "episode_length": self._steps,
            "scene": self._scene.index,
            "seed": self._seed,
            "instruction": self.task_description,
        }


def make_env(config: WmrlManiSkillEnv, freeze: bool) -> gym.Env:
    """One environment; `freeze` stops it after an episode until lerobot-eval starts the next rollout."""
    env = ManiSkillEnv(config)
    return FreezeAfterEpisodeEnd(env) if freeze else env


def make_vector_env(
    config: WmrlManiSkillEnv, n_envs: int, use_async_envs: bool, freeze: bool
) -> gym.vector.VectorEnv:
    """`n_envs` environments with SAME_STEP autoreset, in processes of their own if `use_async_envs`.

    With `freeze`, as lerobot-eval wants it, they log the success by scene when they are closed.
    """
    factories = [partial(make_env, config, freeze)] * n_envs
    if use_async_envs and n_envs > 1:
        context = simulating_context().get_start_method()
        kind = CountingAsyncVectorEnv if freeze else AsyncVectorEnv
        return kind(factories, context=context, autoreset_mode=AutoresetMode.SAME_STEP)
    return (CountingSyncVectorEnv if freeze else SyncVectorEnv)(
        factories, autoreset_mode=AutoresetMode.SAME_STEP
    )
