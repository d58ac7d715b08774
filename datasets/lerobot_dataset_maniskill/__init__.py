"""Records manipulation trajectories in ManiSkill as a LeRobotDataset."""

import lerobot_wmrl  # noqa: F401  (answers --help before LeRobot is imported)
