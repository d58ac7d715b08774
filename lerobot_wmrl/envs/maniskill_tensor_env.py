"""The simulator behind the tensor interface of reinforcement learning; the world model has the same."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW, FPS, STATE_NAMES
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.maniskill_env import make_vector_env


class ManiSkillTensorEnv(gym.vector.VectorEnv):
    """B simulators, tensors on `device`, SAME_STEP autoreset.

    Observation: `observation.images.<camera>` (B, 3, H, W) float32 in [0, 1], `observation.state` (B, 8),
    `task` (B instructions). When an episode ended in this step, `info["final_obs"]` has the observations
    before the reset (rows of the others equal `obs`), `info["final_info"]` `is_success` and
    `episode_length`, each (B,).
    """

    metadata = {"render_fps": FPS, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 (gymnasium's own)

    def __init__(self, config: WmrlManiSkillEnv, n_envs: int, device: str) -> None:
        self.envs = make_vector_env(config, n_envs, use_async_envs=n_envs > 1, freeze=False)
        self.config, self.num_envs, self.device = config, n_envs, torch.device(device)
        self.single_action_space, self.action_space = self.envs.single_action_space, self.envs.action_space
        self.single_observation_space = observation_space(config)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n_envs)
        self.max_episode_steps = config.horizon
        self._low, self._high = np.array(ACTION_LOW, np.float32), np.array(ACTION_HIGH, np.float32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, info = self.envs.reset(seed=seed, options=options)
        self._instructions = [str(text) for text in info["instruction"]]
        return self._tensors(observation, self._instructions), {}

    def step(self, action: Tensor) -> tuple[dict[str, Any], Tensor, Tensor, Tensor, dict[str, Any]]:
        clipped = np.clip(action.detach().cpu().numpy(), self._low, self._high)
        before = self._instructions
        observation, reward, terminated, truncated, info = self.envs.step(clipped)
        ended = terminated | truncated
        if ended.any():
            self._instructions = [
                str(new) if over else old
                for old, new, over in zip(before, info["instruction"], ended, strict=True)
            ]
        result = self._tensors(observation, self._instructions)
        extra: dict[str, Any] = {}
        if ended.any():
            extra["final_obs"] = self._tensors(_final_observation(observation, info, ended), before)
            extra["final_info"] = {
                "is_success": torch.from_numpy(terminated.copy()).to(self.device),
                "episode_length": self._vector(info["final_info"]["episode_length"]),
            }
        return result, self._vector(reward).float(), self._vector(terminated), self._vector(truncated), extra

    def close_extras(self, **kwargs: Any) -> None:
        self.envs.close()

    def _vector(self, values: Any) -> Tensor:
        return torch.from_numpy(np.asarray(values)).to(self.device)

    def _tensors(self, observation: dict[str, Any], instructions: list[str]) -> dict[str, Any]:
        pictures = {camera: self._vector(image) for camera, image in observation["pixels"].items()}
        return {
            **image_observations(pictures),
            OBS_STATE: self._vector(observation["agent_pos"]),
            "task": list(instructions),
        }


def observation_space(config: WmrlManiSkillEnv) -> gym.spaces.Dict:
    """Of one simulator: camera images (3, H, W) in [0, 1], and the state."""
    picture = gym.spaces.Box(0.0, 1.0, (3, config.image_size, config.image_size), np.float32)
    images = {f"{OBS_IMAGES}.{camera}": picture for camera in config.cameras}
    state = gym.spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32)
    return gym.spaces.Dict({**images, OBS_STATE: state})


def image_observations(pictures: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """camera → (B, H, W, 3) uint8 becomes `observation.images.<camera>` → (B, 3, H, W) float32 in [0, 1]."""
    return {
        f"{OBS_IMAGES}.{camera}": picture.permute(0, 3, 1, 2).float() / 255.0
        for camera, picture in pictures.items()
    }


def _final_observation(
    observation: dict[str, Any], info: dict[str, Any], ended: np.ndarray
) -> dict[str, Any]:
    """The last observations of the ended episodes, the current ones of the others."""
    pixels = {camera: image.copy() for camera, image in observation["pixels"].items()}
    state = observation["agent_pos"].copy()
    for row in np.flatnonzero(ended):
        last = info["final_obs"][row]
        state[row] = last["agent_pos"]
        for camera, image in pixels.items():
            image[row] = last["pixels"][camera]
    return {"pixels": pixels, "agent_pos": state}
