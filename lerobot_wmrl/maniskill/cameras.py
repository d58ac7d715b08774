"""Cameras, chosen so that what decides an episode shows in one small picture.

The third view looks back at the robot from the front, steeply: how far the gripper is to the object's side
is a distance in the picture, and a pushed object comes towards the camera, in front of the hand. From an
oblique view a gripper that passes before the object looks like one that pushes it: world models believed it.
The side view stands beside the table: it sees how far an object is pushed or pulled, and what the hand hides
from the front.
"""

from dataclasses import dataclass
from typing import Any

import sapien
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

Point = tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """A fixed camera: where it stands and looks (m), and its field of view (rad)."""

    eye: Point
    target: Point
    fov: float


FAR = 5.0
"""What is further away (m) is not drawn."""

VIEWS = {
    "third_view": View((0.52, 0.0, 0.60), (0.0, -0.035, 0.035), 0.53),
    "side_view": View((0.0, 0.55, 0.42), (0.0, -0.035, 0.04), 0.6),
}
"""Fixed cameras by name; `benchmarks/camera_probe.py` measures what can be read from them."""

WRIST_POSITION = (0.08, 0.0, 0.0)
WRIST_QUATERNION = (0.5736, 0.0, -0.8192, 0.0)
"""In the hand's axes: along the fingers, leaning 20 degrees towards them."""
WRIST_FOV = 1.2


def camera_config(name: str, image_size: int, robot: Any) -> CameraConfig:
    """The configuration of the camera `name`, square, `image_size` pixels. ValueError if unknown."""
    frame = {"uid": name, "width": image_size, "height": image_size, "near": 0.01, "far": FAR}
    if name in VIEWS:
        view = VIEWS[name]
        return CameraConfig(pose=sapien_utils.look_at(view.eye, view.target), fov=view.fov, **frame)
    if name != "wrist":
        raise ValueError(f"camera {name!r} is unknown; choose from {', '.join((*VIEWS, 'wrist'))}")
    pose = sapien.Pose(p=WRIST_POSITION, q=WRIST_QUATERNION)
    return CameraConfig(pose=pose, fov=WRIST_FOV, mount=robot.links_map["panda_hand"], **frame)
