"""A visitor of the page: what they ask for, message by message."""

from collections.abc import Mapping
from typing import Any, Final

import torch

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.play.checks import is_numbers, whole_number
from lerobot_wmrl.play.drive import Drive
from lerobot_wmrl.play.saving import SavedEpisodes
from lerobot_wmrl.play.world import World

YOU: Final = "you"
"""The driver whose actions come with the messages."""


class Visit:
    """A visitor's drive, drivers and real environment.

    Args:
        world: what all visitors share.
        saved: where their episodes are saved.
    """

    def __init__(self, world: World, saved: SavedEpisodes) -> None:
        self.world, self.saved = world, saved
        self.drivers = {name: world.driver(name) for name in world.driver_names()}
        self.real_env: Any = None
        self.drive: Drive | None = None
        self.place: dict[str, Any] = {}
        self.driver = ""

    def answer(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a message asks for.

        Args:
            message: `do` is `begin` (with a place, see `World.begin`), `step` (`driver`, and `action` if this
                is `you`), `rewind` (`frame`), `save` (`success`, by default what the world model says) or
                `resume`.

        Returns:
            What the page is told, as JSON.

        Raises:
            FieldError: it cannot be done; nothing has changed.
        """
        does = {
            "begin": self._begin,
            "step": self._step,
            "rewind": self._rewind,
            "save": self._save,
            "resume": self._resume,
        }
        chosen = does.get(str(message.get("do")))
        if chosen is None:
            raise FieldError("do", message.get("do"), f"choose one of {', '.join(does)}")
        return chosen(message)

    def close(self) -> None:
        """Close the real environment."""
        if self.real_env is not None:
            self.real_env.close()

    def _begin(self, message: Mapping[str, Any]) -> dict[str, Any]:
        if self.real_env is None and "seed" in message:
            self.real_env = self.world.make_real_env()
        try:
            self.drive = self.world.begin(message, self.real_env)
        except ValueError:
            if self.drive is not None and "seed" in message:  # the real environment may stand elsewhere now
                self.drive.synchronized = False
            raise
        self.driver = ""
        self.place = {name: message[name] for name in message if name != "do"}
        return self._resume(message)

    def _resume(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return all of the drive, for a page that was loaded anew."""
        if self.drive is None:
            return {"begun": None, "views": []}
        followed = [] if self.drive.recorded is None else self.drive.recorded.actions.tolist()
        begun = {
            "place": self.place,
            "instruction": self.drive.instruction,
            "goal": self.drive.goal,
            "recorded": len(followed),
            "action": followed[0] if followed else [],
        }
        return {"begun": begun, "views": self.drive.views}

    def _step(self, message: Mapping[str, Any]) -> dict[str, Any]:
        drive, name = self._driving(message), message.get("driver")
        drive.require_running()
        if name == YOU:
            values = message.get("action")
            if not is_numbers(values):
                raise FieldError("action", values, "must be a list of finite numbers")
            action = torch.tensor([values], dtype=torch.float32)
        elif name in self.drivers:
            if name != self.driver:
                self.drivers[name].reset()
            action = self.drivers[name].act(drive).float()
        else:
            raise FieldError("driver", name, f"choose one of {', '.join([YOU, *self.drivers])}")
        view = drive.step(action, name)
        self.driver = name
        return {"view": view}

    def _rewind(self, message: Mapping[str, Any]) -> dict[str, Any]:
        drive = self._driving(message)
        drive.rewind(whole_number("frame", message.get("frame"), drive.frame))
        self.driver = ""
        return {"rewound": drive.frame}

    def _save(self, message: Mapping[str, Any]) -> dict[str, Any]:
        drive, success = self._driving(message), message.get("success")
        if success is None:
            success = drive.succeeds(self.world.criterion)
        if not isinstance(success, bool):
            raise FieldError("success", success, "must be true or false")
        episode = self.saved.add(drive.replay(), drive.frame, drive.instruction, success)
        return {"saved": episode, "success": success, "folder": str(self.saved.folder)}

    def _driving(self, message: Mapping[str, Any]) -> Drive:
        if self.drive is None:
            raise FieldError("do", message["do"], "nothing has begun", "begin first")
        return self.drive
