"""LeRobot's Meta-World with frames of 96 pixels, for machines without a GPU: `--env.type=metaworld_small`.

    pip install examples/metaworld
    MUJOCO_GL=egl lerobot-eval --env.type=metaworld_small --env.task=drawer-open-v3 --policy.path=FOLDER

LeRobot's environment renders 480 pixels, whose antialiasing and shadows take software most of a second. This
one changes the rendering alone: actions, robot state, starts, success and ends are LeRobot's.
"""

from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, MetaworldEnv

SIDE: Final = 96
"""Height and width of the frames in pixels."""

GYM_ID: Final = "gym_metaworld_small/Task-v0"


def make(task: str, **settings: Any) -> gym.Env:
    """Return LeRobot's environment of a task, which renders SIDE pixels without antialiasing and shadows."""
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
    from lerobot.envs.metaworld import MetaworldEnv as Environment

    class SmallMetaworld(Environment):
        def _ensure_env(self) -> None:
            if self._env is not None:
                return
            super()._ensure_env()
            inner = self._env
            inner.mujoco_renderer.close()
            inner.model.vis.quality.offsamples = inner.model.vis.quality.shadowsize = 0
            inner.mujoco_renderer = MujocoRenderer(
                inner.model, inner.data, width=SIDE, height=SIDE, camera_name=self.camera_name
            )

    return SmallMetaworld(task, observation_width=SIDE, observation_height=SIDE, **settings)


gym.register(GYM_ID, entry_point=make, disable_env_checker=True)


@EnvConfig.register_subclass("metaworld_small")
@dataclass
class MetaworldSmall(MetaworldEnv):
    """A task of LeRobot's Meta-World, seen in small frames."""

    task: str = "drawer-open-v3"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, feature in self.features.items():
            if feature.type is FeatureType.VISUAL:
                self.features[name] = PolicyFeature(FeatureType.VISUAL, (SIDE, SIDE, 3))

    @property
    def gym_id(self) -> str:
        """The one environment, which is told its task."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What `make` is given."""
        return {"task": self.task, **super().gym_kwargs}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """Return `n_envs` of the task."""
        return EnvConfig.create_envs(self, n_envs, use_async_envs)
