"""A tensor environment in numpy, for lerobot-eval."""

import logging
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGE, OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.actions import warn_of_clipped
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.images import to_pixels


class EvaluationAdapter(gym.vector.VectorEnv):
    """A tensor environment as lerobot-eval drives it: numpy arrays, and finished episodes that stand still.

    lerobot-eval counts one step past the end of an episode. A finished sub-environment is therefore frozen:
    its last observation is repeated with reward 0 until the next rollout resets all.
    """

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self.env: Any = env
        self.num_envs = env.num_envs
        self.metadata = env.metadata
        self.single_action_space, self.action_space = env.single_action_space, env.action_space
        self._max_episode_steps = self.env.max_episode_steps
        self._clipped: list[float] = []
        self._seeds, self._repeats = set[int](), False

    @cached_property
    def single_observation_space(self) -> gym.Space[Any]:
        """What one environment shows."""
        return numpy_space(self.env.single_observation_space)

    @cached_property
    def observation_space(self) -> gym.Space[Any]:
        """What all environments show."""
        return gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every sub-environment; `seed` is an int or one for each of them."""
        if isinstance(seed, list | tuple):
            self._count_starts(seed)
        self._last, info = self.env.reset(seed=seed)
        self._frozen = torch.zeros(self.num_envs, dtype=torch.bool, device=self.env.device)
        self._success = torch.zeros_like(self._frozen)
        return self._to_numpy(self._last), info

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all, and repeat the last observation of those that were frozen before."""
        observation, reward, terminated, truncated, info = self.env.step(
            torch.from_numpy(np.asarray(actions))
        )
        self._count_clipped(info.get("reward_parts", {}).get("clipped"))
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

    def _count_starts(self, seeds: Sequence[int]) -> None:
        """Warn, once, of a world model's episodes that begin where another one has begun. LeRobot fills the
        last batch up with episodes that it does not count."""
        starts = len(getattr(self.env, "starts", ())) or math.inf
        begun = len(self._seeds)
        self._seeds.update(seeds)
        if begun >= starts and len(self._seeds) > begun and not self._repeats:
            self._repeats = True
            logging.warning(
                "there are %d starts for more episodes: from the same start a policy does the same again, "
                "which says nothing new, unless its actions are drawn or have noise. Ask for %d episodes, "
                "or give more starts (env.dataset)",
                starts,
                starts,
            )

    def _count_clipped(self, shares: Tensor | None) -> None:
        """Keep the share of action components (B,) that were out of range, of environments that go on."""
        if shares is not None:
            self._clipped.extend(shares[~self._frozen].tolist())

    def _hold(self, held: Observation, new: Observation) -> Observation:
        """Return `held` in the rows of frozen sub-environments and `new` in the others."""
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
        images = images_to_numpy(observation)
        converted: Observation = {"pixels": images.get(OBS_IMAGE, images)}
        if OBS_STATE in observation:
            converted["agent_pos"] = observation[OBS_STATE].cpu().numpy()
        return converted

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return one value for each sub-environment.

        Args:
            name: `task`, `task_description`, `render` or `_max_episode_steps`.
        """
        if name == "render":
            return tuple(next(iter(images_to_numpy(self._last).values())))
        if name in ("task", "task_description"):
            return tuple(self._last["task"])
        return (getattr(self, name),) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    def close(self, **kwargs: Any) -> None:
        """Close the environment, and say how many actions it could not take as they were."""
        warn_of_clipped(self._clipped)
        self._clipped = []
        self.env.close(**kwargs)


def images_to_numpy(observation: Observation) -> dict[str, np.ndarray]:
    """Return each camera's images of a batch: (B, 3, H, W) float in [0, 1] → (B, H, W, 3) uint8.

    Cameras are named without `observation.images.`; LeRobot's `observation.image` keeps its name.
    """
    prefix = f"{OBS_IMAGES}."
    return {
        key.removeprefix(prefix): to_pixels(value)
        for key, value in observation.items()
        if key.startswith(OBS_IMAGE)
    }


def numpy_space(space: Any) -> gym.spaces.Dict:
    """Return the space of the observations that `EvaluationAdapter` makes of those in `space`."""
    cameras = {
        key.removeprefix(f"{OBS_IMAGES}."): gym.spaces.Box(0, 255, (*box.shape[1:], 3), np.uint8)
        for key, box in space.items()
        if key.startswith(OBS_IMAGE)
    }
    state = {"agent_pos": space[OBS_STATE]} if OBS_STATE in space.spaces else {}
    pixels = cameras.get(OBS_IMAGE) or gym.spaces.Dict(cameras)
    return gym.spaces.Dict({"pixels": pixels, **state})
