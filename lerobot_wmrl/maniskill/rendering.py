"""Lights and cameras in the simulator."""

from typing import Any, Final

import sapien
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

from lerobot_wmrl.maniskill.cameras import VIEWS, WRIST
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


def camera_config(name: str, image_size: int, robot: Any) -> CameraConfig:
    """Return ManiSkill's configuration of a square camera of `image_size` pixels.

    Args:
        name: one of `cameras.CAMERAS`; ValueError if unknown.
        image_size: pixels of each side.
        robot: ManiSkill's articulation, on whose hand the wrist camera is mounted.
    """
    frame = {
        "uid": name,
        "width": image_size,
        "height": image_size,
        "near": NEAR,
        "far": FAR,
        "shader_config": sensor_shaders(),
    }
    if name in VIEWS:
        view = VIEWS[name]
        return CameraConfig(pose=sapien_utils.look_at(view.eye, view.target), fov=view.fov, **frame)
    if name != WRIST:
        raise ValueError(f"camera {name!r} is unknown; choose from {', '.join((*VIEWS, WRIST))}")
    pose = sapien.Pose(p=WRIST_POSITION, q=WRIST_QUATERNION)
    return CameraConfig(pose=pose, fov=WRIST_FOV, mount=robot.links_map["panda_hand"], **frame)
