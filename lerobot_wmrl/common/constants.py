"""Names and numbers that the recorder, the environments and the models agree on."""

from typing import Final

FPS: Final = 25
"""Control and recording rate in Hz."""

STATE_NAMES: Final = ("tcp_x", "tcp_y", "tcp_z", "tcp_qw", "tcp_qx", "tcp_qy", "tcp_qz", "gripper_opening")
"""`observation.state`: TCP position (m), TCP quaternion wxyz, gripper opening in [0, 1]."""

ACTION_NAMES: Final = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
"""`action`: commanded TCP delta (m), XYZ Euler angles of its rotation (rad), gripper in [-1, 1] (+1 opens).
Deltas and angles are along and about the axes of the base."""

ACTION_LOW: Final = (-0.05, -0.05, -0.05, -0.25, -0.25, -0.25, -1.0)
ACTION_HIGH: Final = (0.05, 0.05, 0.05, 0.25, 0.25, 0.25, 1.0)
"""The one action box: both environments clip to it, the recorder never exceeds it."""

TASKS: Final = ("push", "pull", "pick_place", "move_to_aim")
"""Vocabulary of the column `start.task`."""

POLICY: Final = "policy"
PLAY: Final = "play"
HUMAN_LIKE: Final = "human_like"
KINDS: Final = ("optimal", "waypoint", "interpolated", "noisy", "near_miss", POLICY, PLAY, HUMAN_LIKE)
"""Vocabulary of the column `start.kind`: how an episode's actions were made. Datasets store the index."""

START_COLUMNS: Final = ("start.task", "start.scene", "start.seed", "start.kind")
"""int64 (1,) columns from which an episode's start can be rebuilt in the simulator."""

START_TASK, START_SCENE, START_SEED, START_KIND = START_COLUMNS

EVALUATION_SEED: Final = 1_000_000
"""Recording and training seeds are below this number, evaluation seeds from it to the next."""

SELECTION_SEED: Final = 2_000_000
"""First of the seeds on which the checkpoints of a training are compared."""

GATE_SEED: Final = 3_000_000
"""First of the seeds of the rollouts that a world model is asked about while a policy trains in it."""
