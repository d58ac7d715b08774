"""What the policy takes from an observation: one picture and the instruction."""

from typing import Any

from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor

from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig

TASK = "task"


def look(config: OpenVLAConfig, observation: dict[str, Any]) -> tuple[Tensor, list[str]]:
    """→ pictures (B, 3, H, W), instructions. ValueError if the observation does not have them."""
    camera = camera_name(config, observation)
    images = observation[camera]
    instructions = observation.get(TASK)
    if isinstance(instructions, str):
        instructions = [instructions] * len(images)
    if instructions is None or len(instructions) != len(images):
        given = "none" if instructions is None else len(instructions)
        raise ValueError(
            f"observation.task: needs one instruction a picture, {len(images)}; there are {given}"
        )
    return images, list(instructions)


def camera_name(config: OpenVLAConfig, observation: dict[str, Any]) -> str:
    """The camera it was trained on; else the one that is named, or the only one there is."""
    shown = sorted(name for name in observation if name.startswith(OBS_IMAGES))
    wanted = list(config.input_features or ()) or ([config.camera] if config.camera else shown)
    if len(wanted) != 1 or wanted[0] not in shown:
        raise ValueError(
            f"the policy needs {', '.join(wanted) or 'a camera'}, the environment or dataset shows "
            f"{', '.join(shown) or 'none'}: use one with the camera that the policy was trained on, or name "
            "one of them, --policy.camera"
        )
    return wanted[0]
