"""What pictures are taken of a scene, and how much light and cameras vary from episode to episode."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import sapien
from transforms3d.euler import euler2quat

from lerobot_wmrl.common.constants import IMAGE_SIZE, ROBOT_MESH_DETAIL

AMBIENT: Final = (0.45, 0.45, 0.45)
SUN: Final = (1.5, 1.5, 1.5)
SUN_DIRECTION: Final = (-0.15, 0.1, -1.0)

JITTER_STREAM: Final = 1 << 21
"""Tells these draws from those of the starts, which are seeded by (seed, task, scene)."""

LOOKING_DISTANCE: Final = 0.7
"""From a fixed camera to what it looks at (m), about."""


@dataclass(frozen=True)
class Rendering:
    """What pictures are taken.

    Args:
        cameras: names from `constants.CAMERAS`; none of them is fastest.
        image_size: pixels of each side.
        depth: whether each camera also measures depth.
        robot_mesh_detail: share of the robot's triangles that are drawn; 1 draws ManiSkill's own meshes.
        light_jitter: standard deviation of the lights' brightness, as a share, and of the sun's direction;
            drawn once an episode.
        camera_jitter: standard deviation (m) of the fixed cameras' positions, drawn once an episode; their
            directions vary as much at the distance of the table.
    """

    cameras: tuple[str, ...] = ("third_view",)
    image_size: int = IMAGE_SIZE
    depth: bool = False
    robot_mesh_detail: float = ROBOT_MESH_DETAIL
    light_jitter: float = 0.0
    camera_jitter: float = 0.0


class Variation:
    """Moves lights and cameras a little, the same way for the same episode."""

    def __init__(self, scene: Any, cameras: dict[str, Any], rendering: Rendering) -> None:
        """`cameras`: name → sapien's camera component, of the fixed cameras only."""
        self.scene, self.cameras, self.rendering = scene, cameras, rendering
        self.poses = {name: camera.local_pose for name, camera in cameras.items()}
        self.suns = [
            component
            for entity in scene.entities
            for component in entity.components
            if isinstance(component, sapien.render.RenderDirectionalLightComponent)
        ]

    def draw(self, *episode: int) -> None:
        """Set lights and cameras for the episode of these numbers."""
        rng = np.random.default_rng((JITTER_STREAM, *episode))
        if self.rendering.light_jitter:
            self._light(rng)
        if self.rendering.camera_jitter:
            for name in sorted(self.cameras):
                self.cameras[name].local_pose = self.poses[name] * self._shift(rng)

    def _light(self, rng: np.random.Generator) -> None:
        share = self.rendering.light_jitter
        ambient, sun = np.exp(share * rng.normal(size=2))
        self.scene.set_ambient_light(ambient * np.array(AMBIENT))
        direction = np.array(SUN_DIRECTION) + share * np.array([*rng.normal(size=2), 0.0])
        for light in self.suns:
            light.color = sun * np.array(SUN)
            light.entity.pose = sapien.Pose(light.entity.pose.p, _rotation_of_x(direction))

    def _shift(self, rng: np.random.Generator) -> sapien.Pose:
        metres = self.rendering.camera_jitter * rng.normal(size=3)
        turn = self.rendering.camera_jitter / LOOKING_DISTANCE * rng.normal(size=3)
        return sapien.Pose(metres, euler2quat(*turn))


def _rotation_of_x(direction: np.ndarray) -> np.ndarray:
    """The quaternion (wxyz) that turns the x axis, along which a light shines, to `direction` (3,)."""
    x, y, z = direction / np.linalg.norm(direction)
    return euler2quat(0.0, -np.arcsin(z), np.arctan2(y, x))
