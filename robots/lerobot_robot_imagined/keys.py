"""The keys that end an episode in lerobot-record."""

from importlib import import_module
from threading import Lock
from typing import Any, Final

from lerobot.utils.keyboard_input import apply_recording_control

LISTENERS: Final[Any] = import_module(apply_recording_control.__module__)
"""LeRobot's module whose listeners call that function by its name in it."""


class EpisodeKeys:
    """Notices the keys with which somebody ends an episode in lerobot-record.

    LeRobot tells a robot nothing of them, and of two that read a terminal each would miss keys that the other
    gets. So this takes the place of the function to which LeRobot's own listeners give them, until `close`.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._pending: tuple[str, dict[str, Any]] | None = None
        self._ended: list[str] = []
        self._apply = LISTENERS.apply_recording_control
        LISTENERS.apply_recording_control = self._take

    def ended(self) -> list[str]:
        """Return the keys at which LeRobot's command has ended episodes since the last call.

        Each is "right", "left" or "esc". One that the command has not noticed yet is not among them: until
        then it records the same episode.
        """
        with self._lock:
            self._settle()
            ended, self._ended = self._ended, []
            return ended

    def close(self) -> None:
        """Give the keys to LeRobot alone again."""
        LISTENERS.apply_recording_control = self._apply

    def _take(self, control: str, events: dict[str, Any]) -> None:
        with self._lock:
            self._settle()
            again = self._pending is not None and self._pending[0] == "left"
            self._apply(control, events)
            self._pending = "left" if again else control, events

    def _settle(self) -> None:
        """Note that the command has noticed the last key, if it has."""
        if self._pending is not None and not self._pending[1]["exit_early"]:
            self._ended.append(self._pending[0])
            self._pending = None
