"""A tensor environment as lerobot-eval wants it: numpy, and finished sub-environments that stand still."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

Observation = dict[str, Any]


class EvaluationAdapter(gym.vector.VectorEnv):
    """lerobot-eval counts one step past the end of an episode, so a finished sub-environment is frozen: its
    last observation is repeated with reward 0 until the next rollout resets all."""

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self.env: Any = env
        self.num_envs = env.num_envs
        self.metadata = env.metadata
        self.single_action_space, self.action_space = env.single_action_space, env.action_space
        self.single_observation_space = shown_space(env.single_observation_space)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, env.num_envs)
        self._max_episode_steps = self.env.max_episode_steps

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Thaw and restart all; `seed` may be an int or one a sub-environment."""
        self._last, info = self.env.reset(seed=seed)
        self._frozen = torch.zeros(self.num_envs, dtype=torch.bool, device=self.env.device)
        self._success = torch.zeros_like(self._frozen)
        return self._to_numpy(self._last), info

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all, then hold back what was frozen before."""
        observation, reward, terminated, truncated, info = self.env.step(
            torch.from_numpy(np.asarray(actions))
        )
        ended = (terminated | truncated) & ~self._frozen
        self._last = self._hold(self._last, info.get("final_obs", observation))
        if "final_info" in info:
            self._success = torch.where(ended, info["final_info"]["is_success"], self._success)
        reward = reward.masked_fill(self._frozen, 0.0)
        self._frozen = self._frozen | ended
        result = (
            {"final_info": {"is_success": self._success.cpu().numpy()}} if bool(self._frozen.any()) else {}
        )
        flags = (terminated & ended).cpu().numpy(), (truncated & ended).cpu().numpy()
        return self._to_numpy(self._last), reward.cpu().numpy(), *flags, result

    def _hold(self, held: Observation, new: Observation) -> Observation:
        """Rows of frozen sub-environments from `held`, the others from `new`."""
        kept: Observation = {}
        for key, value in new.items():
            if isinstance(value, Tensor):
                kept[key] = torch.where(self._frozen.reshape(-1, *[1] * (value.ndim - 1)), held[key], value)
            else:
                frozen = self._frozen.tolist()
                kept[key] = [
                    old if stop else now for old, now, stop in zip(held[key], value, frozen, strict=True)
                ]
        return kept

    def _to_numpy(self, observation: Observation) -> Observation:
        converted: Observation = {"pixels": pictures(observation)}
        if OBS_STATE in observation:
            converted["agent_pos"] = observation[OBS_STATE].cpu().numpy()
        return converted

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """One value a sub-environment: `task`, `task_description`, `render`, `_max_episode_steps`."""
        if name == "render":
            return tuple(next(iter(self._to_numpy(self._last)["pixels"].values())))
        if name in ("task", "task_description"):
            return tuple(self._last["task"])
        return (getattr(self, name),) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    def close(self, **kwargs: Any) -> None:
        self.env.close(**kwargs)


def pictures(observation: Observation) -> dict[str, np.ndarray]:
    """Camera → (B, H, W, 3) uint8."""
    prefix = f"{OBS_IMAGES}."
    return {
        key.removeprefix(prefix): (value.permute(0, 2, 3, 1) * 255).round().byte().cpu().numpy()
        for key, value in observation.items()
        if key.startswith(prefix)
    }


def shown_space(space: Any) -> gym.spaces.Dict:
    """That of the same observation as `_to_numpy` shows it."""
    cameras = {
        key.removeprefix(f"{OBS_IMAGES}."): gym.spaces.Box(0, 255, (*box.shape[1:], 3), np.uint8)
        for key, box in space.items()
        if key.startswith(OBS_IMAGES)
    }
    state = {"agent_pos": space[OBS_STATE]} if OBS_STATE in space.spaces else {}
    return gym.spaces.Dict({"pixels": gym.spaces.Dict(cameras), **state})
