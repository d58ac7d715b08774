"""The person as a teleoperator of LeRobot, `--teleop.type=scripted_person`."""

import json
import os
import pty
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator


@TeleoperatorConfig.register_subclass("scripted_person")
@dataclass
class ScriptedPersonConfig(TeleoperatorConfig):
    """Settings of the person.

    Args:
        script: what they do, one episode after the other.
    """

    script: str = ""


class ScriptedPerson(Teleoperator):
    """Sends the actions of a script, and presses `n` at an episode's last: on a terminal of its own, which it
    gives to lerobot-record as its standard input."""

    config_class, name = ScriptedPersonConfig, "scripted_person"
    feedback_features: dict[str, type] = {}  # noqa: RUF012
    is_connected = is_calibrated = True

    def __init__(self, config: ScriptedPersonConfig) -> None:
        super().__init__(config)
        script = json.loads(Path(config.script).read_text())
        self.stdin = sys.stdin
        self.names, self.script = script["names"], script["actions"]

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self.names, float)

    def connect(self, calibrate: bool = True) -> None:
        self.episode = self.frame = 0
        self.keyboard, terminal = pty.openpty()
        self.terminal = sys.stdin = os.fdopen(terminal)

    def get_action(self) -> dict[str, float]:
        if self.episode == len(self.script):
            raise RuntimeError("lerobot-record did not keep up with the keys: record again")
        actions = self.script[self.episode]
        action = actions[self.frame]
        self.frame += 1
        if self.frame == len(actions):
            os.write(self.keyboard, b"n")
            self.episode, self.frame = self.episode + 1, 0
        return dict(zip(self.names, action, strict=True))

    def disconnect(self) -> None:
        """Give the standard input back; LeRobot uses the terminal once more after this."""
        sys.stdin = self.stdin

    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
