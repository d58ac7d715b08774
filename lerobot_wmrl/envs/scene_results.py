"""Success by scene, which lerobot-eval does not report: the environments log it when they are closed.

They count whole batches, lerobot-eval only its number of episodes.
"""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.maniskill.scenes import SCENES, UNSEEN_OBJECTS, Scene


class SceneResults:
    """Outcomes of a task's episodes by scene. One is identified by its seed and counts when it first ends."""

    def __init__(self, task: str) -> None:
        self.task = task
        self.episodes: dict[int, tuple[Scene, bool]] = {}

    def add(self, info: Mapping[str, np.ndarray], ended: np.ndarray) -> None:
        """Add the episodes that ended.

        Args:
            info: `seed`, `scene` and `is_success` of all rows, (B,) each.
            ended: which rows count, (B,) bool.
        """
        for row in np.flatnonzero(ended):
            scene = SCENES[int(info["scene"][row])]
            self.episodes.setdefault(int(info["seed"][row]), (scene, bool(info["is_success"][row])))

    def log(self) -> None:
        """Log the table, if there was an episode."""
        if self.episodes:
            logging.info(
                "Success in %s by scene, of all %d episodes:\n%s", self.task, len(self.episodes), self.table()
            )

    def table(self) -> str:
        """Return the rates of scenes, of the groups of held-out scenes and of all, with 95 % intervals."""
        lines = [_line(_name(scene), self._rate({scene.index})) for scene in self._scenes()]
        for name, scenes in self._groups().items():
            lines.append(_line(name, self._rate({scene.index for scene in scenes})))
        return "\n".join(lines)

    def _scenes(self) -> list[Scene]:
        return sorted({scene for scene, _ in self.episodes.values()}, key=lambda scene: scene.index)

    def _groups(self) -> dict[str, list[Scene]]:
        held_out = [scene for scene in self._scenes() if scene.split == "ood"]
        unseen = [scene for scene in held_out if scene.object in UNSEEN_OBJECTS]
        combined = [scene for scene in held_out if scene not in unseen]
        groups = {"unseen objects": unseen, "unseen combinations": combined, "all scenes": self._scenes()}
        return {name: scenes for name, scenes in groups.items() if scenes}

    def _rate(self, indices: set[int]) -> Proportion:
        outcomes = [success for scene, success in self.episodes.values() if scene.index in indices]
        return Proportion.of(outcomes)


def _name(scene: Scene) -> str:
    return f"{scene.index:>2} {scene.object}, {scene.container}, {scene.table}"


def _line(name: str, rate: Proportion) -> str:
    return f"{name:<34} {rate}"


class _Counting:
    """Mixin of a vector environment that counts the episodes that end, and logs the table on closing."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.results = SceneResults(self.call("task")[0])  # type: ignore[attr-defined]

    def step(self, actions: Any) -> tuple[Any, ...]:
        result: tuple[Any, ...] = super().step(actions)  # type: ignore[misc]
        _, _, terminated, truncated, info = result
        if "final_info" in info:
            self.results.add(info["final_info"], terminated | truncated)
        return result

    def close_extras(self, **kwargs: Any) -> None:
        super().close_extras(**kwargs)  # type: ignore[misc]
        self.results.log()


class CountingSyncVectorEnv(_Counting, SyncVectorEnv):
    """Environments in this process, which log success by scene."""


class CountingAsyncVectorEnv(_Counting, AsyncVectorEnv):
    """Environments in processes of their own, which log success by scene."""
