"""An imagined episode that somebody drives, with a real environment beside it that takes the same actions.

A drive is where it begins and the actions since: the world model is deterministic, so going back means
imagining anew.
"""

import base64
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import gymnasium as gym
import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import jpeg, to_pixels
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.start_frames import StartImages
from lerobot_wmrl.envs.world_model_env import Observation, WorldModels, WorldModelVectorEnv, make_env_at
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_frame_tokenizer import split_cameras


class Step(NamedTuple):
    """An action (A,), the observation before it (batch of one), and the reward after it."""

    before: Observation
    action: np.ndarray
    reward: float


class Recorded(NamedTuple):
    """What followed in the dataset where a drive began: actions (T, A) and images (T, N, H, W, 3) uint8, the
    first of which is the start."""

    actions: np.ndarray
    images: np.ndarray


class RealEpisode:
    """An episode of a real environment. It waits when it has ended.

    Args:
        name: name of the environment.
        env: a tensor environment of one episode.
        seed: seed of its start.
    """

    def __init__(self, name: str, env: gym.vector.VectorEnv, seed: int) -> None:
        self.name, self.env, self.seed = name, env, seed
        self.reset()

    def reset(self) -> None:
        """Begin again."""
        self.observation, _ = self.env.reset(seed=[self.seed])
        self.ended = ""

    def step(self, action: Tensor) -> None:
        """Take an action (1, A)."""
        if self.ended:
            return
        observation, _, terminated, truncated, info = self.env.step(action)
        self.observation = info.get("final_obs", observation)
        if bool((terminated | truncated)[0]):
            succeeded = bool(info["final_info"]["is_success"][0])
            self.ended = "success" if succeeded else "end"


class Drive:
    """An imagined episode, driven step by step.

    Args:
        start: the frame where it begins.
        models: the world models.
        config: configuration of the imagined episodes.
        recorded: what followed in the dataset, if it begins there.
        real: a real episode with the same start, if there is one.
    """

    def __init__(
        self,
        start: StartImages,
        models: WorldModels,
        config: WorldModelEnv,
        recorded: Recorded | None = None,
        real: RealEpisode | None = None,
    ) -> None:
        self.models, self.recorded, self.real = models, recorded, real
        self.env: WorldModelVectorEnv = make_env_at(start, models, config, 1)
        self.instruction = start.instructions[0]
        self.goal = self._goal_images(start)
        self.actions: list[Tensor] = []
        self.views: list[dict[str, Any]] = []
        self.synchronized = True
        self._reset()
        self.views.append(self._view(""))

    @property
    def frame(self) -> int:
        """Number of actions since the start."""
        return len(self.actions)

    def step(self, action: Tensor, driver: str) -> dict[str, Any]:
        """Take an action (1, A) of a driver, by name.

        Returns:
            What the page shows of the next frame.

        Raises:
            FieldError: the episode has ended, or the action is none of A finite numbers.
        """
        self.require_running()
        if tuple(action.shape) != self.env.action_space.shape or not bool(action.isfinite().all()):
            raise FieldError(
                "action",
                action.flatten().tolist(),
                f"must be {self.env.single_action_space.shape[0]} finite numbers",
            )
        self.synchronized = False
        self._advance(action)
        if self.real is not None:
            self.real.step(action)
        self.actions.append(action)
        self.views.append(self._view(driver))
        self.synchronized = True
        return self.views[-1]

    def require_running(self) -> None:
        """Raise FieldError if the episode has ended."""
        self._catch_up()
        if self.ended:
            raise FieldError(
                "step", self.frame, f"the episode has ended ({self.ended})", "go back or restart"
            )

    def rewind(self, frame: int) -> None:
        """Go back to a frame: imagine its past anew, and repeat it in the real environment."""
        if not 0 <= frame <= self.frame:
            raise FieldError("frame", frame, f"must be from 0 to {self.frame}")
        self.synchronized = False
        self.actions, self.views = self.actions[:frame], self.views[: frame + 1]
        self._catch_up()

    def replay(self) -> Iterator[Step]:
        """Imagine the episode once more, and yield its steps. The drive ends up where it was."""
        self.synchronized = False
        self._reset()
        for action in self.actions:
            before = self.observation
            self._advance(action)
            box = self.env.single_action_space
            yield Step(before, np.clip(action[0].numpy(), box.low, box.high), self.measured["reward"])
        self.synchronized = True  # and the real environment has stayed where it was

    def succeeds(self, criterion: SuccessCriterion) -> bool:
        """Return whether the criterion is met by the last frames."""
        last = self.views[1:][-criterion.frames :]
        return len(last) == criterion.frames and all(
            view["measured"].get("done_probability", 0.0) >= criterion.threshold for view in last
        )

    def _catch_up(self) -> None:
        """Take all actions again unless the environments are where the drive is, as after an error."""
        if self.synchronized:
            return
        self._reset()
        if self.real is not None:
            self.real.reset()
        for action in self.actions:
            self._advance(action)
            if self.real is not None:
                self.real.step(action)
        self.synchronized = True

    def _reset(self) -> None:
        self.observation, _ = self.env.reset(seed=[0])
        self.ended, self.measured = "", dict[str, float]()

    def _advance(self, action: Tensor) -> None:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.observation = info.get("final_obs", observation)
        parts = {name: float(value[0]) for name, value in info["reward_parts"].items()}
        self.measured = {"reward": float(reward[0]), **parts}
        if bool((terminated | truncated)[0]):
            self.ended = "success" if bool(terminated[0]) else "end"

    def _view(self, driver: str) -> dict[str, Any]:
        """Return what the page shows of the newest frame, as JSON."""
        view: dict[str, Any] = {
            "frame": self.frame,
            "driver": driver,
            "images": encode_observation(self.observation),
            "action": [] if not self.actions else self.actions[-1][0].tolist(),
            "measured": {name: value for name, value in self.measured.items() if math.isfinite(value)},
            "ended": self.ended,
        }
        if self.real is not None:
            cameras = self.env.model.config.tokenizer.camera_keys
            images = encode_observation(self.real.observation, cameras)
            view["beside"] = {"name": self.real.name, "images": images, "ended": self.real.ended}
        elif self._follows_recording():
            assert self.recorded is not None
            images = encode_images(self._in_frame_sizes(self.recorded.images[self.frame]))
            view["beside"] = {"name": "recorded", "images": images, "ended": ""}
        return view

    def _follows_recording(self) -> bool:
        """Return whether all actions so far are those of the dataset, so that its frames can be compared."""
        return (
            self.recorded is not None
            and self.frame < len(self.recorded.images)
            and all(map(np.array_equal, (each[0] for each in self.actions), self.recorded.actions))
        )

    def _in_frame_sizes(self, squares: np.ndarray) -> list[np.ndarray]:
        """Stretch a recorded frame (N, S, S, 3) to the sizes of the dataset's frames."""
        shapes = self.env.model.config.tokenizer.frame_shapes.values()
        pairs = zip(squares, shapes, strict=True)
        return [cv2.resize(np.ascontiguousarray(each), (width, height)) for each, (_, height, width) in pairs]

    def _goal_images(self, start: StartImages) -> list[str]:
        """Return the goal frame that the text world model imagines, encoded; empty without one."""
        text_model, frames = self.models.text_model, self.env.starts.frames
        if text_model is None:
            return []
        state = torch.from_numpy(start.state).to(self.env.device)
        goal = imagine_goal(
            text_model, replace(frames, state=state, depth=start.depth(text_model)), start.instructions
        )
        shapes = self.env.model.config.tokenizer.frame_shapes
        return encode_observation(split_cameras(goal.decoded.images, shapes))


def encode_observation(observation: Observation, cameras: Sequence[str] = ()) -> list[str]:
    """Encode the images of a batch of one, of these cameras or of all."""
    names = cameras or [name for name in observation if name.startswith(OBS_IMAGE)]
    return encode_images([to_pixels(observation[name][0]) for name in names])


def encode_images(images: Sequence[np.ndarray] | np.ndarray) -> list[str]:
    """Encode images (H, W, 3) uint8 as addresses of data, which a browser shows."""
    return [f"data:image/jpeg;base64,{base64.b64encode(jpeg(each)).decode()}" for each in images]
