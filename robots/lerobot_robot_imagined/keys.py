"""The keys that end an episode in LeRobot's commands."""

from threading import Lock
from typing import Any

from lerobot.utils import keyboard_input


class EpisodeKeys:
    """Notices the keys with which somebody ends an episode in lerobot-record or lerobot-rollout.

    LeRobot tells a robot nothing of them, and of two that read a terminal each would miss keys that the other
    gets. So this takes the place of the function to which LeRobot's own listeners give them, until `close`.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._last: tuple[str, dict[str, Any]] | None = None
        self._apply = keyboard_input.apply_recording_control
        keyboard_input.apply_recording_control = self._take

    def pressed(self) -> str | None:
        """Return the key at which LeRobot's command has just ended an episode: "right", "left" or "esc".

        None before the command has noticed it, too: until then it records the same episode.
        """
        with self._lock:
            if self._last is None or self._last[1]["exit_early"]:
                return None
            (key, _), self._last = self._last, None
            return key

    def close(self) -> None:
        """Give the keys to LeRobot alone again."""
        keyboard_input.apply_recording_control = self._apply

    def _take(self, control: str, events: dict[str, Any]) -> None:
        with self._lock:
            self._apply(control, events)
            self._last = control, events
