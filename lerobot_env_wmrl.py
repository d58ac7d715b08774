"""The module LeRobot's plugin discovery imports (its name is the distribution's name).

Importing `lerobot_wmrl` registers every policy, reward model, environment and algorithm of this project.
"""

import lerobot_wmrl  # noqa: F401
