"""Names and numbers that the recorder, the environments and the models agree on."""

from typing import Final

ROBOT_MESH_DETAIL: Final = 0.04
"""Share of the robot's triangles that are drawn: three times faster, the same picture at 64 and 128 px."""

IMAGE_SIZE: Final = 128
"""Pixels of each side of a picture, unless told otherwise."""

FPS: Final = 25
"""Control and recording rate in Hz."""

CAMERAS: Final = ("third_view", "side_view", "wrist")

STATE_NAMES: Final = ("tcp_x", "tcp_y", "tcp_z", "tcp_qw", "tcp_qx", "tcp_qy", "tcp_qz", "gripper_opening")
"""`observation.state`: TCP position (m), TCP quaternion wxyz, gripper opening in [0, 1]."""

ACTION_NAMES: Final = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
"""`action`: commanded TCP delta (m), XYZ Euler angles of its rotation (rad), gripper in [-1, 1] (+1 opens).
Deltas and angles are along and about the axes of the base."""

ACTION_LOW: Final = (-0.05, -0.05, -0.05, -0.25, -0.25, -0.25, -1.0)
ACTION_HIGH: Final = (0.05, 0.05, 0.05, 0.25, 0.25, 0.25, 1.0)
"""The one action box: both environments clip to it, the recorder never exceeds it."""

WORKSPACE_FLOOR: Final = 0.015
"""The simulator moves the TCP no lower (m), as a real robot's controller would. At 0.009 the fingertips
scrape over the table, and how they stick and slip there can be neither learnt nor repeated."""

TASKS: Final = ("push", "pull", "pick_place", "move_to_aim")
"""Vocabulary of the column `start.task`."""

PLAY: Final = "play"
KINDS: Final = ("optimal", "waypoint", "interpolated", "noisy", "near_miss", "policy", PLAY)
"""Vocabulary of the column `start.kind`: how an episode's actions were made."""

START_COLUMNS: Final = ("start.task", "start.scene", "start.seed", "start.kind")
"""int64 (1,) columns from which an episode's start can be rebuilt in the simulator."""

EVALUATION_SEED: Final = 1_000_000
"""Recording and training seeds are below this number, evaluation seeds from it to the next."""

SELECTION_SEED: Final = 2_000_000
"""First of the seeds on which the checkpoints of a training are compared."""

GATE_SEED: Final = 3_000_000
"""First of the seeds of the rollouts that a world model is asked about while a policy trains in it."""
