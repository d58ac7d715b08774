"""The cameras, and the settings of the pictures. Imports no simulator.

The cameras are placed so that what decides an episode shows in one small picture. The third view looks back
at the robot from the front, steeply: how far the gripper is to the object's side is a distance in the
picture, and a pushed object comes towards the camera, in front of the hand. From an oblique view, a gripper
that passes before the object looks like one that pushes it, and world models learnt false successes from it.
The side view stands beside the table: it sees how far an object is pushed or pulled, and what the hand hides
from the front."""

from dataclasses import dataclass
from typing import Final

Point = tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """A fixed camera: its position and target (m), and its field of view (rad)."""

    eye: Point
    target: Point
    fov: float


VIEWS: Final = {
    "third_view": View((0.52, 0.0, 0.60), (0.0, -0.035, 0.035), 0.53),
    "side_view": View((0.0, 0.55, 0.42), (0.0, -0.035, 0.04), 0.6),
}
"""Name → fixed camera. `experiments/steps/camera_probe.py` measures what can be read from their pictures."""

WRIST: Final = "wrist"
CAMERAS: Final = (*VIEWS, WRIST)

IMAGE_SIZE: Final = 128
"""Pixels of each side of a picture, unless told otherwise."""

ROBOT_MESH_DETAIL: Final = 0.04
"""Share of the robot's triangles that are drawn: three times faster, the same picture at 64 and 128 px."""


@dataclass(frozen=True)
class Rendering:
    """Which pictures are taken.

    Args:
        cameras: names from `CAMERAS`. Without cameras the simulation runs fastest.
        image_size: pixels of each side.
        depth: whether each camera also measures depth.
        robot_mesh_detail: share of the robot's triangles that are drawn; 1 draws ManiSkill's own meshes.
    """

    cameras: tuple[str, ...] = ("third_view",)
    image_size: int = IMAGE_SIZE
    depth: bool = False
    robot_mesh_detail: float = ROBOT_MESH_DETAIL
