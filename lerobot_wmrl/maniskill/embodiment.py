"""The robot of the simulator as datasets describe it: rate, state and actions. Imports no simulator."""

from typing import Final

import numpy as np

from lerobot_wmrl.data.embodiment import POSITION_NAMES

FPS: Final = 25
"""Control and recording rate in Hz."""

STATE_NAMES: Final = (*POSITION_NAMES, "tcp_qw", "tcp_qx", "tcp_qy", "tcp_qz", "gripper_opening")
"""`observation.state`: TCP position (m), TCP quaternion wxyz, gripper opening in [0, 1]."""

ACTION_NAMES: Final = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
"""`action`: commanded TCP delta (m), XYZ Euler angles of its rotation (rad), gripper in [-1, 1] (+1 opens).
Deltas and angles are along and about the axes of the base."""

ACTION_LOW: Final = (-0.05, -0.05, -0.05, -0.25, -0.25, -0.25, -1.0)
ACTION_HIGH: Final = (0.05, 0.05, 0.05, 0.25, 0.25, 0.25, 1.0)
"""The range of actions: the environment clips to it, the recorder never exceeds it."""

TRANSLATION: Final = np.array(ACTION_HIGH[:3])
"""Largest displacement a step along each axis, which exploration noise is measured by. (3,)"""
