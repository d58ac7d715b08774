"""A robot that a world model imagines."""

import logging
import time
from collections.abc import Mapping
from typing import Any, Final

import torch
from lerobot.robots import Robot
from lerobot.utils.constants import OBS_STATE

from lerobot_robot_imagined.config_imagined import ImaginedRobotConfig
from lerobot_robot_imagined.keys import EpisodeKeys
from lerobot_wmrl.common.actions import clip_actions, warn_of_clipped
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import to_pixels
from lerobot_wmrl.envs.configuration_world_model import DrivenEnv
from lerobot_wmrl.envs.start_frames import read_start_images
from lerobot_wmrl.envs.world_model_env import load_world_models, make_env_at
from lerobot_wmrl.world_models.checkpoint import read_config

LONGEST: Final = 1_000_000
"""Frames of an episode at most: LeRobot's commands end it, not the world model."""

DISPLACEMENTS: Final = {"delta_x": ("dx", "x"), "delta_y": ("dy", "y"), "delta_z": ("dz", "z")}
"""Actions of LeRobot's keyboard and gamepad, each in [−1, 1], and the components that they move."""

GRIPPER: Final = "gripper"


class ImaginedRobot(Robot):
    """Camera images and state as a world model imagines them after each action.

    Observations are named as in the world model's dataset: a number for each component of the state, and an
    image (H, W, 3) uint8 for each camera. Actions are a number for each component, in the dataset's units, or
    what LeRobot's keyboard and gamepad send (`delta_x`, `delta_y`, `delta_z`, `gripper`).
    """

    config_class = ImaginedRobotConfig
    name = "imagined"

    def __init__(self, config: ImaginedRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.model = read_config(config.world_model_path, "action_world_model")
        self.env: Any = None
        self.keys: EpisodeKeys | None = None
        self.succeeded = False
        self.began: float | None = None
        self.clipped: list[float] = []

    @property
    def cameras(self) -> dict[str, tuple[int, int, int]]:
        """Image shapes (H, W, 3) by camera."""
        tokenizer = self.model.trained_tokenizer
        shapes = zip(tokenizer.cameras, tokenizer.frame_shapes.values(), strict=True)
        return {camera.rpartition(".")[2]: (height, width, 3) for camera, (_, height, width) in shapes}

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(self._names("state"), float), **self.cameras}

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self._names("action"), float)

    @property
    def is_connected(self) -> bool:
        return self.env is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Load the world model and begin the first episode."""
        config = self.config
        env = DrivenEnv(
            world_model_path=config.world_model_path,
            dataset=config.dataset,
            episode_length=LONGEST,
            done_threshold=config.done_threshold,
            done_frames=config.done_frames,
            device=config.device,
        )
        models = load_world_models(env, env.device)
        self.env = make_env_at(read_start_images(config.dataset, models.model.config), models, env, 1)
        self.keys = EpisodeKeys()
        self.start = config.first_start
        self._begin()
        logging.info(
            "the world model has learnt %d frames a second: use this as the command's fps",
            self.model.embodiment.fps,
        )

    def disconnect(self) -> None:
        """Forget the world model, and say how many actions were out of its range."""
        warn_of_clipped(self.clipped)
        self.clipped.clear()
        self.env = None
        if self.keys is not None:
            self.keys.close()
            self.keys = None

    def get_observation(self) -> dict[str, Any]:
        """Return the newest frame, that of the next episode if this one is over."""
        if not self.is_connected:
            raise ConnectionError("the imagined robot is not connected")
        assert self.keys is not None
        keys = self.keys.ended()
        if keys or self._is_late():
            self.start += sum(key != "left" for key in keys) if keys else 1
            self._begin()
        self.began = self.began or time.perf_counter()
        state = self.observation[OBS_STATE][0].tolist() if OBS_STATE in self.observation else []
        images = (to_pixels(self.observation[key][0]) for key in self.model.trained_tokenizer.camera_keys)
        return dict(zip(self.observation_features, [*state, *images], strict=True))

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Imagine the next frame; after a success the robot stands still.

        Returns:
            The action in the dataset's units, within its range.

        Raises:
            FieldError: it lacks a component.
        """
        if not self.is_connected:
            raise ConnectionError("the imagined robot is not connected")
        components = {name.removesuffix(self.config.suffix): float(value) for name, value in action.items()}
        names = self.model.embodiment.action_names
        if "delta_x" in components and "delta_x" not in names:
            components = self._displaced(components)
        if missing := [name for name in names if name not in components]:
            raise FieldError(
                "teleop.type",
                ", ".join(action),
                f"the world model's actions need {', '.join(missing)} too",
                f"use a teleoperator whose actions are {', '.join(names)}, or keyboard_ee or gamepad",
            )
        wanted = torch.tensor([[components[name] for name in names]], dtype=torch.float32)
        self.last, share = clip_actions(wanted, self.env.action_low.cpu(), self.env.action_high.cpu())
        self.clipped.append(float(share))
        if not self.succeeded:
            observation, _, terminated, _, info = self.env.step(self.last)
            self.observation = info.get("final_obs", observation)
            self.succeeded = bool(terminated[0])
        return dict(zip(self.action_features, self.last[0].tolist(), strict=True))

    def _names(self, kind: str) -> list[str]:
        """Return the names of the components of `state`, if it is imagined, or of `action`."""
        if kind == "state" and not self.model.state_size:
            return []
        return [f"{name}{self.config.suffix}" for name in getattr(self.model.embodiment, f"{kind}_names")]

    def _begin(self) -> None:
        """Begin an episode in the frame whose turn it is."""
        self.observation, _ = self.env.reset(seed=[self.start])
        self.began, self.succeeded = None, False
        self.last = self.env.model.action_mean[None].cpu()

    def _is_late(self) -> bool:
        """Return whether the episode's time is up."""
        limit = self.config.episode_time_s
        return limit is not None and self.began is not None and time.perf_counter() - self.began >= limit

    def _displaced(self, sent: Mapping[str, float]) -> dict[str, float]:
        """Return the action that a keyboard's or gamepad's displacement stands for.

        Displacements are shares of half the range. A gripper's 0 closes it, 2 opens it, and 1 leaves it as it
        is. What else there is stays at rest: at 0 where its range has it, else at the dataset's mean.
        """
        names = self.model.embodiment.action_names
        ends = (self.env.action_low, self.env.action_high, self.env.model.action_mean, self.last[0])
        low, high, mean, last = (dict(zip(names, each.tolist(), strict=True)) for each in ends)
        action = {name: 0.0 if low[name] <= 0 <= high[name] else mean[name] for name in names}
        for key, candidates in DISPLACEMENTS.items():
            component = next((name for name in candidates if name in names), None)
            if component is None:
                raise FieldError(
                    "teleop.type",
                    key,
                    f"the world model's actions have no {' or '.join(candidates)}",
                    f"use a teleoperator whose actions are {', '.join(names)}",
                )
            action[component] += sent.get(key, 0.0) * (high[component] - low[component]) / 2
        if GRIPPER in names:
            gripper = {0.0: low[GRIPPER], 2.0: high[GRIPPER]}
            action[GRIPPER] = gripper.get(sent.get(GRIPPER, 1.0), last[GRIPPER])
        return action
