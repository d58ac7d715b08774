"""Tasks by name: the one definition of success for the recorder, the environments and every evaluation."""

from typing import Final

from lerobot_wmrl.maniskill.tasks.base import Situation, Start, Task
from lerobot_wmrl.maniskill.tasks.move_to_aim import MoveToAim
from lerobot_wmrl.maniskill.tasks.pick_place import PickPlace
from lerobot_wmrl.maniskill.tasks.push import Pull, Push

__all__ = ["TASKS", "MoveToAim", "PickPlace", "Pull", "Push", "Situation", "Start", "Task", "task_of"]

TASKS: Final[dict[str, Task]] = {task.name: task for task in (Push(), Pull(), PickPlace(), MoveToAim())}


def task_of(name: str | None) -> Task:
    """The registered task called `name`. ValueError if there is none."""
    if name not in TASKS:
        raise ValueError(f"task={name!r} is unknown; choose one of {', '.join(TASKS)}")
    return TASKS[name]
