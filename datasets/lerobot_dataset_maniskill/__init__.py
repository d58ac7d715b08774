"""Records manipulation trajectories in ManiSkill as a LeRobotDataset."""
