"""Cameras, chosen so that what decides an episode shows in one small picture.

The third view looks back at the robot from the front, steeply: how far the gripper is to the object's side
is a distance in the picture, and a pushed object comes towards the camera, in front of the hand. From an
oblique view a gripper that passes before the object looks like one that pushes it: world models believed it.
"""

from typing import Any

import sapien
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

from lerobot_wmrl.constants import CAMERAS

THIRD_VIEW_EYE = (0.52, 0.0, 0.60)
THIRD_VIEW_TARGET = (0.0, -0.035, 0.035)
THIRD_VIEW_FOV = 0.53
WRIST_POSITION = (0.08, 0.0, 0.0)
WRIST_QUATERNION = (0.5736, 0.0, -0.8192, 0.0)
"""In the hand's axes: along the fingers, leaning 20 degrees towards them."""
WRIST_FOV = 1.2


def camera_config(name: str, image_size: int, robot: Any) -> CameraConfig:
    """The configuration of the camera `name`, square, `image_size` pixels. ValueError if unknown."""
    if name not in CAMERAS:
        raise ValueError(f"camera {name!r} is unknown; choose from {', '.join(CAMERAS)}")
    frame = {"uid": name, "width": image_size, "height": image_size, "near": 0.01, "far": 5.0}
    if name == "third_view":
        pose = sapien_utils.look_at(THIRD_VIEW_EYE, THIRD_VIEW_TARGET)
        return CameraConfig(pose=pose, fov=THIRD_VIEW_FOV, **frame)
    pose = sapien.Pose(p=WRIST_POSITION, q=WRIST_QUATERNION)
    return CameraConfig(pose=pose, fov=WRIST_FOV, mount=robot.links_map["panda_hand"], **frame)
