"""Lights and cameras in the simulator, and how they vary from episode to episode."""

from typing import Any, Final

import numpy as np
import sapien
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from transforms3d.euler import euler2quat

from lerobot_wmrl.maniskill.cameras import VIEWS, WRIST, Rendering
from lerobot_wmrl.maniskill.shaders import sensor_shaders

AMBIENT: Final = (0.45, 0.45, 0.45)
SUN: Final = (1.5, 1.5, 1.5)
SUN_DIRECTION: Final = (-0.15, 0.1, -1.0)

NEAR: Final = 0.01
FAR: Final = 5.0
"""Only what is between these distances from a camera (m) is drawn."""

WRIST_POSITION: Final = (0.08, 0.0, 0.0)
WRIST_QUATERNION: Final = (0.5736, 0.0, -0.8192, 0.0)
"""Pose of the wrist camera in the hand's axes: along the fingers, leaning 20 degrees towards them."""

WRIST_FOV: Final = 1.2

JITTER_STREAM: Final = 1 << 21
"""Separates the random stream of the jitter from that of the starts, which is seeded by (seed, task,
scene)."""

LOOKING_DISTANCE: Final = 0.7
"""Approximate distance from a fixed camera to its target (m)."""


def camera_config(name: str, image_size: int, robot: Any) -> CameraConfig:
    """Return ManiSkill's configuration of a square camera of `image_size` pixels.

    Args:
        name: one of `cameras.CAMERAS`; ValueError if unknown.
        image_size: pixels of each side.
        robot: ManiSkill's articulation, on whose hand the wrist camera is mounted.
    """
    frame = {
        "uid": name, "width": image_size, "height": image_size, "near": NEAR, "far": FAR,
        "shader_config": sensor_shaders(),
    }  # fmt: skip
    if name in VIEWS:
        view = VIEWS[name]
        return CameraConfig(pose=sapien_utils.look_at(view.eye, view.target), fov=view.fov, **frame)
    if name != WRIST:
        raise ValueError(f"camera {name!r} is unknown; choose from {', '.join((*VIEWS, WRIST))}")
    pose = sapien.Pose(p=WRIST_POSITION, q=WRIST_QUATERNION)
    return CameraConfig(pose=pose, fov=WRIST_FOV, mount=robot.links_map["panda_hand"], **frame)


class Variation:
    """Jitter of lights and fixed cameras: a function of the episode's numbers.

    Args:
        scene: SAPIEN's scene.
        cameras: name → SAPIEN's camera component, of the fixed cameras only.
        rendering: how much they vary.
    """

    def __init__(self, scene: Any, cameras: dict[str, Any], rendering: Rendering) -> None:
        self.scene, self.cameras, self.rendering = scene, cameras, rendering
        self.poses = {name: camera.local_pose for name, camera in cameras.items()}
        self.suns = [
            component
            for entity in scene.entities
            for component in entity.components
            if isinstance(component, sapien.render.RenderDirectionalLightComponent)
        ]

    def draw(self, *episode: int) -> None:
        """Set lights and cameras for the episode with these numbers (seed, task, scene)."""
        rng = np.random.default_rng((JITTER_STREAM, *episode))
        if self.rendering.light_jitter:
            self._draw_light(rng)
        if self.rendering.camera_jitter:
            for name in sorted(self.cameras):
                self.cameras[name].local_pose = self.poses[name] * self._draw_shift(rng)

    def _draw_light(self, rng: np.random.Generator) -> None:
        share = self.rendering.light_jitter
        ambient, sun = np.exp(share * rng.normal(size=2))
        self.scene.set_ambient_light(ambient * np.array(AMBIENT))
        direction = np.array(SUN_DIRECTION) + share * np.array([*rng.normal(size=2), 0.0])
        for light in self.suns:
            light.color = sun * np.array(SUN)
            light.entity.pose = sapien.Pose(light.entity.pose.p, _rotation_of_x(direction))

    def _draw_shift(self, rng: np.random.Generator) -> sapien.Pose:
        metres = self.rendering.camera_jitter * rng.normal(size=3)
        turn = self.rendering.camera_jitter / LOOKING_DISTANCE * rng.normal(size=3)
        return sapien.Pose(metres, euler2quat(*turn))


def _rotation_of_x(direction: np.ndarray) -> np.ndarray:
    """Return the quaternion (wxyz) that turns the x axis, along which a light shines, to `direction` (3,)."""
    x, y, z = direction / np.linalg.norm(direction)
    return euler2quat(0.0, -np.arcsin(z), np.arctan2(y, x))
