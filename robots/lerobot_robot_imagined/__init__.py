"""A robot that a world model imagines, `--robot.type=imagined` in LeRobot's own commands."""
