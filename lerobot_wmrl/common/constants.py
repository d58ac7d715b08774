"""Names, types and numbers that the recorder, the environments and the models agree on."""

from typing import Any, Final

Observation = dict[str, Any]
"""Tensors by LeRobot's names, batch first, and `task`: a list of instructions."""

INSTRUCTIONS: Final = "task"
"""LeRobot's name of the instructions in an observation."""

TASK_NAMES: Final = ("push", "pull", "pick_place", "move_to_aim")
"""Vocabulary of the column `start.task`."""

POLICY: Final = "policy"
PLAY: Final = "play"
HUMAN_LIKE: Final = "human_like"
KINDS: Final = ("optimal", "waypoint", "interpolated", "noisy", "near_miss", POLICY, PLAY, HUMAN_LIKE)
"""Vocabulary of the column `start.kind`: how an episode's actions were made. Datasets store the index."""

START_COLUMNS: Final = ("start.task", "start.scene", "start.seed", "start.kind")
"""int64 (1,) columns from which an episode's start can be rebuilt in the simulator."""

START_TASK, START_SCENE, START_SEED, START_KIND = START_COLUMNS

DONE_THRESHOLD: Final = 0.5
"""Predicted success probability from which a frame counts as done (θ, eq. 7), where nothing else is given."""

DONE_FRAMES: Final = 3
"""Consecutive done frames that make an imagined success, where nothing else is given."""

DYNA: Final = "dyna"
"""Folder of a training's output in which the world models of its Dyna rounds are."""
