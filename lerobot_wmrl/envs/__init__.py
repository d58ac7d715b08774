"""The world-model environment and the ManiSkill environment, as LeRobot environments."""
