"""How many steps of an environment an evaluation takes: in reality they are what costs."""

from typing import Any

import gymnasium as gym
import numpy as np


class StepCounter:
    """A vector environment that counts, in `steps`, those of episodes that had not ended yet."""

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self.env, self.steps = env, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Every sub-environment begins an episode."""
        self._running = np.ones(self.env.num_envs, bool)
        return self.env.reset(**kwargs)

    def step(self, actions: Any) -> tuple[Any, ...]:
        """One step of those whose first episode since the reset goes on."""
        self.steps += int(self._running.sum())
        result: tuple[Any, ...] = self.env.step(actions)
        self._running &= ~(result[2] | result[3])
        return result
