"""The person as a teleoperator of LeRobot, `--teleop.type=scripted_person`."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator


@TeleoperatorConfig.register_subclass("scripted_person")
@dataclass
class ScriptedPersonConfig(TeleoperatorConfig):
    """Settings of the person.

    Args:
        script: what they do, one episode after the other.
        episode_time_s: the robot's, after which the next episode begins.
    """

    script: str = ""
    episode_time_s: float = 1.6


class ScriptedPerson(Teleoperator):
    """Sends the actions of a script. An episode begins when the robot's does: after its time is up."""

    config_class, name = ScriptedPersonConfig, "scripted_person"
    feedback_features: dict[str, type] = {}  # noqa: RUF012
    is_connected = is_calibrated = True

    def __init__(self, config: ScriptedPersonConfig) -> None:
        super().__init__(config)
        script = json.loads(Path(config.script).read_text())
        self.names, self.script = script["names"], script["actions"]
        self.limit = config.episode_time_s

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self.names, float)

    def connect(self, calibrate: bool = True) -> None:
        self.episode, self.frame = -1, 0
        self.began = -np.inf

    def get_action(self) -> dict[str, float]:
        if time.perf_counter() - self.began >= self.limit:
            self.episode, self.frame, self.began = self.episode + 1, 0, time.perf_counter()
        actions = self.script[self.episode]
        action = actions[min(self.frame, len(actions) - 1)]
        self.frame += 1
        return dict(zip(self.names, action, strict=True))

    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
    def disconnect(self) -> None: ...
