"""The general reward, as a LeRobot reward model."""
