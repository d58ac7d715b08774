"""The world model and ManiSkill as LeRobot environments."""
