"""The point environment as an `--env.type`, for commands that train outside a world model."""

from dataclasses import dataclass
from typing import Any

from lerobot.envs.configs import EnvConfig

from tests.rl.point_env import PointEnv


@EnvConfig.register_subclass("test_point")
@dataclass
class PointConfig(EnvConfig):
    """The point environment, drawn in 32x32 pixels, with episodes of at most four steps."""

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_tensor_env(self, n_envs: int, device: str) -> PointEnv:
        return PointEnv(n_envs, horizon=4, image_size=32)
