"""gym-hil's cube, to be picked up, as an environment of LeRobot's commands: `--env.type=hil_pick`.

    pip install examples/gym_hil
    MUJOCO_GL=egl lerobot-eval --env.type=hil_pick --policy.path=FOLDER --eval.batch_size=1

LeRobot drives gym-hil by its HIL-SERL scripts alone. Any Gymnasium environment becomes one of LeRobot's in
this way: a wrapper whose `info` has `is_success` and whose starts follow from the seed, and a configuration
that says which of its observations are cameras and which the robot's state. Nothing here imports
`lerobot_wmrl`.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import gymnasium as gym
import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

TASK: Final = "pick up the cube"
FPS: Final = 10
STEPS: Final = 60
"""Longest episode."""

HELD: Final = 8
"""Frames in a row in which the cube is 10 cm above the table, after which an episode ends. gym-hil ends it at
the first of them, so that no recorded frame shows success: each is from before its action."""

SIDE: Final = 64
"""Height and width of the frames in pixels; gym-hil has 128."""

CAMERAS: Final = ("front", "wrist")


class PickCube(gym.Wrapper):
    """The cube somewhere on the table, the gripper above it.

    Actions are (4,): three displacements of the gripper from -1 to 1, of 2.5 cm at most, and the gripper,
    which 0 opens further, 1 leaves as it is, and 2 closes further. gym-hil's rewards are 1 for success.

    Frames are rendered without antialiasing and shadows: in software they would take a second a step.
    """

    task = "pick_cube"
    task_description = TASK
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(self, steps: int = STEPS) -> None:
        import mujoco
        from gym_hil.envs import PandaPickCubeGymEnv
        from gym_hil.wrappers.factory import wrap_env

        env = PandaPickCubeGymEnv(image_obs=True, random_block_position=True)
        quality = env.model.vis.quality
        quality.offsamples, quality.shadowsize = 0, 0
        env._viewer.close()
        env._viewer = mujoco.Renderer(env.model, height=SIDE, width=SIDE)
        for camera in CAMERAS:
            env.observation_space["pixels"][camera] = gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)
        super().__init__(wrap_env(env, gripper_penalty=0.0, reset_delay_seconds=0.0))
        self._max_episode_steps, self._steps, self._held = steps, 0, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Put the cube where the seed says. gym-hil draws from numpy's global generator."""
        if seed is not None:
            np.random.seed(seed % 2**32)  # noqa: NPY002
        self._steps = self._held = 0
        observation, _ = self.env.reset(seed=seed)
        return observation, {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move the gripper by an action (4,)."""
        observation, reward, ended, _, info = self.env.step(np.asarray(action, np.float64))
        success = bool(info["succeed"])
        self._steps, self._held = self._steps + 1, self._held + 1 if success else 0
        terminated = self._held >= HELD or (ended and not success)  # the cube is off the table
        truncated = self._steps >= self._max_episode_steps and not terminated
        return observation, float(reward), terminated, truncated, {"is_success": success}

    def render(self) -> np.ndarray:
        """Return what the front camera sees, (SIDE, SIDE, 3)."""
        return self.env.unwrapped.render()[0]


gym.register("gym_hil_pick/PickCube-v0", entry_point=PickCube, disable_env_checker=True)


@EnvConfig.register_subclass("hil_pick")
@dataclass
class GymHilPick(EnvConfig):
    """Its observations by gym-hil's names, and the columns of a dataset that they become."""

    task: str | None = "PickCube-v0"
    fps: int = FPS
    episode_length: int = STEPS
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (4,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (18,)),
            **{f"pixels/{name}": PolicyFeature(FeatureType.VISUAL, (SIDE, SIDE, 3)) for name in CAMERAS},
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "action": "action",
            "agent_pos": "observation.state",
            **{f"pixels/{name}": f"observation.images.{name}" for name in CAMERAS},
        }
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What `PickCube` is given."""
        return {"steps": self.episode_length}
