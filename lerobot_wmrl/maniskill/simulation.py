"""One simulated episode at a time, in numpy: what the recorder and the environments drive."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW, FPS, WORKSPACE_FLOOR
from lerobot_wmrl.maniskill.cameras import VIEWS
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.renderer import render_backend
from lerobot_wmrl.maniskill.rendering import Rendering, Variation
from lerobot_wmrl.maniskill.robot import GRIPPER_OPEN
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tabletop import TabletopEnv
from lerobot_wmrl.maniskill.tasks import Situation, Start, Task


@dataclass(frozen=True)
class Frame:
    """What is known at one control step.

    Args:
        images: camera → (H, W, 3) uint8.
        depth: camera → (H, W, 1) uint16, millimetres along the camera's axis, 0 where nothing is; no entry
            unless it was asked for.
        state: (8,) float32, `constants.STATE_NAMES`.
        reward: the task's rule-based reward of being here.
        success: whether the task is solved here.
    """

    images: dict[str, np.ndarray]
    depth: dict[str, np.ndarray]
    state: np.ndarray
    reward: float
    success: bool


class Episode:
    """What is to be remembered of an episode in order to judge it.

    Args:
        task, scene, seed: which together decide its start.
    """

    object_start: np.ndarray
    object_before: np.ndarray

    def __init__(self, task: Task, scene: Scene, seed: int) -> None:
        self.scene, self.seed, self.start = scene, seed, task.start(scene, seed)

    def begin(self, position: np.ndarray) -> None:
        """The object has been put at `position` (3,)."""
        self.object_start = self.object_before = position

    def situation(self, position: np.ndarray, tcp: np.ndarray, opening: float) -> Situation:
        """What the task judges when the object is at `position` (3,), the TCP at `tcp` (3,)."""
        return Situation(
            self.start, OBJECTS[self.scene.object], CONTAINERS[self.scene.container],
            self.object_start, position, tcp, opening,
            float(np.linalg.norm(position - self.object_before)) * FPS,
        )  # fmt: skip


class Simulation:
    """A ManiSkill table that plays episodes of one task in some scenes.

    Args:
        task: what succeeds and what pays; another may be set before a reset.
        scenes: the scenes that may be asked for.
        rendering: what pictures are taken.
    """

    def __init__(self, task: Task, scenes: Sequence[Scene], rendering: Rendering = Rendering()) -> None:  # noqa: B008 (frozen)
        self.task, self.rendering = task, rendering
        self.env = TabletopEnv(scenes, rendering, render_backend=render_backend())
        self.env.reset(seed=0)
        self.cameras = {name: self.env._sensors[name].camera._render_cameras[0] for name in rendering.cameras}
        fixed = {name: camera for name, camera in self.cameras.items() if name in VIEWS}
        self.variation = Variation(self.env.scene.sub_scenes[0], fixed, rendering)
        self._low, self._high = np.array(ACTION_LOW, np.float32), np.array(ACTION_HIGH, np.float32)

    def reset(self, scene: Scene, seed: int) -> Frame:
        """Rebuild the start of (task, scene, seed). The same arguments give the same frame."""
        self.episode = Episode(self.task, scene, seed)
        self.env.place(scene, self.episode.start)
        self.variation.draw(seed, self.task.index, scene.index)
        self.episode.begin(self.object_position)
        return self._frame()

    def step(self, action: np.ndarray) -> Frame:
        """Apply one action (7,), clipped to the action box and to the workspace, for one control step."""
        clipped = np.clip(np.asarray(action, np.float32), self._low, self._high)
        clipped[2] = max(clipped[2], WORKSPACE_FLOOR - self.tcp_position[2])
        self.episode.object_before = self.object_position
        self.env.step(torch.from_numpy(clipped)[None])
        return self._frame()

    @property
    def current_start(self) -> Start:
        return self.episode.start

    @property
    def instruction(self) -> str:
        return self.current_start.instruction

    @property
    def object_position(self) -> np.ndarray:
        """(3,) centre of the object."""
        return np.asarray(self.env.active._objs[0].pose.p, np.float64)

    @property
    def gripper_opening(self) -> float:
        """0 closed to 1 open."""
        return float(np.clip(self.env.agent.robot._objs[0].qpos[-1] / GRIPPER_OPEN, 0.0, 1.0))

    @property
    def tcp_position(self) -> np.ndarray:
        """(3,)"""
        return np.asarray(self.env.agent.tcp._objs[0].entity.pose.p, np.float64)

    def situation(self) -> Situation:
        """What the task judges now."""
        return self.episode.situation(self.object_position, self.tcp_position, self.gripper_opening)

    def close(self) -> None:
        self.env.close()

    def _frame(self) -> Frame:
        situation = self.situation()
        images, depth = self._pictures()
        reward, success = self.task.reward(situation), self.task.success(situation)
        return Frame(images, depth, self._state(), reward, success)

    def _state(self) -> np.ndarray:
        pose = self.env.agent.tcp._objs[0].entity.pose
        return np.array([*pose.p, *continuous(pose.q), self.gripper_opening], np.float32)

    def _pictures(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Images and depth of every camera."""
        images: dict[str, np.ndarray] = {}
        depth: dict[str, np.ndarray] = {}
        if self.cameras:
            self.env.scene.sub_scenes[0].update_render()
        for name, camera in self.cameras.items():
            camera.take_picture()
            images[name] = np.ascontiguousarray(camera.get_picture("Color")[..., :3])
            if self.rendering.depth:
                backwards = camera.get_picture("PositionSegmentation")[..., 2:3]
                depth[name] = np.negative(backwards).astype(np.uint16)
        return images, depth


def continuous(quaternion: np.ndarray) -> np.ndarray:
    """q or −q, which are the same rotation: the one nearer to a hand that points down, (0, 1, 0, 0) wxyz.

    Otherwise the sign jumps while nothing moves, and drowns the statistics and whoever learns from them.
    """
    return -quaternion if quaternion[1] < 0 else quaternion
