"""From a LeRobotDataset to the clips and frames that models learn from."""
