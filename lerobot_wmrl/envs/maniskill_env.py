"""ManiSkill as an environment: one episode in numpy, several for lerobot-eval, and as tensors for PPO."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.envs.utils import FreezeAfterEpisodeEnd
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.images import from_bytes
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.scene_results import CountingAsyncVectorEnv, CountingSyncVectorEnv
from lerobot_wmrl.envs.tensor_env import Outcome, TensorEnv
from lerobot_wmrl.maniskill.backend import simulating_context
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, FPS, STATE_NAMES
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.scenes import scene_for_seed
from lerobot_wmrl.rewards.general import potential_discount


class ManiSkillEnv(gym.Env):
    """One episode at a time, in numpy. The simulator is built at the first reset.

    Observation: `pixels` {camera: (H, W, 3) uint8}, `agent_pos` (8,) float32. Action (7,): metres, radians,
    gripper. An episode is terminated as soon as success holds, and truncated at the horizon. The seed of a
    reset decides scene and start; a reset without one draws a training seed. The configuration has one task.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"

    def __init__(self, config: WmrlManiSkillEnv) -> None:
        self.config = config
        self._scenes = config.selected_scenes()
        self._max_episode_steps = config.horizon
        self.task = str(config.task)
        self.task_description = ""
        image = gym.spaces.Box(0, 255, (config.image_size, config.image_size, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict(dict.fromkeys(config.cameras, image)),
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
            self.config.reward.step_reward(
                float(terminated), self._frame.reward, before.reward, self._max_episode_steps
            ),
            terminated,
            truncated,
            self._info(self._frame),
        )

    def render(self) -> np.ndarray:
        """Return the first camera's image, (H, W, 3) uint8."""
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
    """Return one environment; `freeze` stops it after an episode until lerobot-eval begins a rollout."""
    env = ManiSkillEnv(config)
    return FreezeAfterEpisodeEnd(env) if freeze else env


def make_vector_env(
    configs: Sequence[WmrlManiSkillEnv], use_async_envs: bool, freeze: bool
) -> gym.vector.VectorEnv:
    """Return an environment of each configuration, with SAME_STEP autoreset.

    Args:
        configs: configurations of one task each; images are of the same cameras and size.
        use_async_envs: whether each has a process of its own.
        freeze: whether episodes stop as lerobot-eval wants it. Success by scene is then logged on closing.
    """
    factories = [partial(make_env, config, freeze) for config in configs]
    if use_async_envs and len(configs) > 1:
        context = simulating_context().get_start_method()
        kind = CountingAsyncVectorEnv if freeze else AsyncVectorEnv
        return kind(factories, context=context, autoreset_mode=AutoresetMode.SAME_STEP)
    return (CountingSyncVectorEnv if freeze else SyncVectorEnv)(
        factories, autoreset_mode=AutoresetMode.SAME_STEP
    )


class ManiSkillTensorEnv(TensorEnv):
    """B simulators, each in a process of its own, with tensors on `device`.

    Row b has task b mod their number. With several tasks `reset` deals out the seeds from the one that is
    given at random: a seed decides the scene, and in their order each task would meet the same few scenes.
    """

    metadata = {"render_fps": FPS, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 (gymnasium's own)

    def __init__(self, config: WmrlManiSkillEnv, n_envs: int, device: str) -> None:
        longest = potential_discount(config.reward, config.horizon)  # PPO has one discount for all tasks
        tasks = replace(config, reward=replace(config.reward, gamma=longest)).each_task()
        self.tasks = len(tasks)
        rows = [tasks[row % self.tasks] for row in range(n_envs)]
        self.envs = make_vector_env(rows, use_async_envs=n_envs > 1, freeze=False)
        self.config, self.num_envs, self.device = config, n_envs, torch.device(device)
        self.single_action_space, self.action_space = self.envs.single_action_space, self.envs.action_space
        self.single_observation_space = observation_space(config)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n_envs)
        self.max_episode_steps = config.horizon
        self.action_low, self.action_high = torch.tensor(ACTION_LOW), torch.tensor(ACTION_HIGH)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        if isinstance(seed, int) and self.tasks > 1:
            seed = (seed + np.random.default_rng(seed).permutation(self.num_envs)).tolist()
        observation, info = self.envs.reset(seed=seed, options=options)
        self._instructions = [str(text) for text in info["instruction"]]
        return self._tensors(observation, self._instructions), {}

    def _advance(self, actions: Tensor) -> Outcome:
        """Take a step; the simulators then begin anew by themselves."""
        self._seen, reward, *ends, self._info = self.envs.step(actions.numpy())
        ended = ends[0] | ends[1]
        last, length = self._seen, np.array(self._info["episode_length"])
        if ended.any():
            last = _final_observation(self._seen, self._info, ended)
            length = np.where(ended, self._info["final_info"]["episode_length"], length)
        terminated, truncated = map(self._vector, ends)
        return Outcome(
            self._tensors(last, self._instructions),
            self._vector(reward).float(),
            terminated,
            truncated,
            terminated,
            self._vector(length),
        )

    def _restart(self, ended: Tensor, outcome: Outcome) -> Observation:
        self._instructions = [
            str(new) if over else old
            for old, new, over in zip(
                self._instructions, self._info["instruction"], ended.tolist(), strict=True
            )
        ]
        return self._tensors(self._seen, self._instructions)

    def close_extras(self, **kwargs: Any) -> None:
        self.envs.close()

    def _vector(self, values: Any) -> Tensor:
        return torch.from_numpy(np.asarray(values)).to(self.device)

    def _tensors(self, observation: dict[str, Any], instructions: list[str]) -> dict[str, Any]:
        images = {camera: self._vector(image) for camera, image in observation["pixels"].items()}
        return {
            **image_observations(images),
            OBS_STATE: self._vector(observation["agent_pos"]),
            "task": list(instructions),
        }


def observation_space(config: WmrlManiSkillEnv) -> gym.spaces.Dict:
    """Return the space of one simulator's tensors: images (3, H, W) in [0, 1] and the state."""
    image = gym.spaces.Box(0.0, 1.0, (3, config.image_size, config.image_size), np.float32)
    images = {f"{OBS_IMAGES}.{camera}": image for camera in config.cameras}
    state = gym.spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32)
    return gym.spaces.Dict({**images, OBS_STATE: state})


def image_observations(images: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Turn camera → (B, H, W, 3) uint8 into `observation.images.<camera>` → (B, 3, H, W) in [0, 1]."""
    return {
        f"{OBS_IMAGES}.{camera}": from_bytes(image.permute(0, 3, 1, 2)) for camera, image in images.items()
    }


def _final_observation(
    observation: dict[str, Any], info: dict[str, Any], ended: np.ndarray
) -> dict[str, Any]:
    """Return the last observations of the ended episodes and the current ones of the others."""
    pixels = {camera: image.copy() for camera, image in observation["pixels"].items()}
    state = observation["agent_pos"].copy()
    for row in np.flatnonzero(ended):
        last = info["final_obs"][row]
        state[row] = last["agent_pos"]
        for camera, image in pixels.items():
            image[row] = last["pixels"][camera]
    return {"pixels": pixels, "agent_pos": state}
