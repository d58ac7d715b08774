"""A vectorised reach in two dimensions that obeys the tensor environment's contract."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.envs.tensor_env import Outcome, TensorEnv

REACH = 0.15
"""Distance from the goal at which an episode succeeds."""


class PointEnv(TensorEnv):
    """Move a point, in steps of at most 0.1 a component, to a goal in [-1, 1]²; only two components act.

    The state is point and goal (B, 4); with `image_size`, they are drawn as a red and a blue square too.
    Every sub-environment's episodes follow from its own seed.
    """

    device = torch.device("cpu")
    refuses_nan_first = False  # so that a step waits for nothing but an end

    def __init__(self, num_envs: int, horizon: int = 15, image_size: int = 0, actions: int = 3) -> None:
        self.num_envs, self.max_episode_steps, self.image_size = num_envs, horizon, image_size
        self.single_action_space = gym.spaces.Box(-0.1, 0.1, (actions,), np.float32)
        self.action_low, self.action_high = torch.full((actions,), -0.1), torch.full((actions,), 0.1)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        seen = {"observation.state": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)}
        if image_size:
            seen["observation.images.third_view"] = gym.spaces.Box(
                0, 1, (3, image_size, image_size), np.float32
            )
        self.single_observation_space = gym.spaces.Dict(seen)
        self.generators = [torch.Generator() for _ in range(num_envs)]

    def reset(
        self, *, seed: int | list[int] | None = None, options: Any = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed or []
        for generator, own in zip(self.generators, seeds, strict=False):
            generator.manual_seed(own)
        self.state, self.elapsed = torch.zeros(self.num_envs, 4), torch.zeros(self.num_envs, dtype=torch.long)
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        return self._observe(), {}

    def _advance(self, actions: Tensor) -> Outcome:
        before = self._distance()
        self.state[:, :2] += actions[:, :2]
        self.elapsed += 1
        distance = self._distance()
        terminated = distance < REACH
        truncated = (self.elapsed >= self.max_episode_steps) & ~terminated
        reward = before - distance + terminated.float()
        return Outcome(self._observe(), reward, terminated, truncated, terminated, self.elapsed.clone())

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing to release."""

    def _restart(self, ended: Tensor, outcome: Outcome) -> dict[str, Any]:
        self._begin(ended)
        return self._observe()

    def _begin(self, rows: Tensor) -> None:
        for row in rows.nonzero()[:, 0].tolist():
            self.state[row] = torch.rand(4, generator=self.generators[row]) * 1.6 - 0.8
        self.elapsed = self.elapsed.masked_fill(rows, 0)

    def _distance(self) -> Tensor:
        return (self.state[:, :2] - self.state[:, 2:]).norm(dim=1)

    def _observe(self) -> dict[str, Any]:
        seen = {"observation.state": self.state.clone(), "task": ["reach the blue square"] * self.num_envs}
        if not self.image_size:
            return seen
        size = self.image_size
        centres = ((self.state + 1) / 2 * (size - 1)).view(-1, 2, 2)
        axis = torch.arange(size)
        near = (centres[..., None] - axis).abs() <= 2
        square = (near[:, :, 1, :, None] & near[:, :, 0, None, :]).float()
        image = square[:, [0, 0, 1]] * torch.tensor([1.0, 0, 1])[:, None, None]
        return {**seen, "observation.images.third_view": image}
