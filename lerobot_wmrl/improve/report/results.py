"""Results of an improvement, read from what its commands wrote: success, training curves, the gate."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.evaluation.comparison import RESULTS, Comparison, read_episodes
from lerobot_wmrl.improve.improvement import Improvement
from lerobot_wmrl.rl.callbacks import RECORD_FILE, Record
from lerobot_wmrl.rl.gate import SuccessGate
from lerobot_wmrl.rl.selection import Selection

MODELS = {"tokenizer": "Frame tokenizer", "world_model": "World model"}
"""Models that are trained, by their folders."""

STEP, ITERATION = "step", "iteration"
"""What the progress of a training is counted in."""

PANELS = {
    "ppo": {
        "success_rate": "PPO: imagined success",
        "reward": "PPO: reward a step",
        "reference_kl": "PPO: KL to the policy that it began with",
    },
    "distillation": {
        "success_rate": "Planner: imagined success after the policy's first steps",
        "policy_loss": "Fitting to the planner: loss",
    },
}
"""Columns of each algorithm's metrics, and their titles."""


class Curve(NamedTuple):
    """A number that a training logs, as it goes on.

    Args:
        x: the training's progress.
        y: the number.
        unit: unit of the progress, `step` or `iteration`.
    """

    x: list[float]
    y: list[float]
    unit: str = STEP


@dataclass(frozen=True)
class Place:
    """Policies compared in one place.

    Args:
        name: the place, as a phrase: `in pusht`.
        comparison: comparison of the policies, by what they are.
    """

    name: str
    comparison: Comparison

    @property
    def rates(self) -> dict[str, Proportion]:
        """Success of each policy."""
        return self.comparison.rates()


def read_place(name: str, folder: Path, titles: Sequence[str]) -> Place:
    """Read a finished comparison of policies, which have these titles, in this order."""
    found = read_json(folder / RESULTS)
    episodes = read_episodes(found)
    starts = len({episode.seed for episode in episodes})
    return Place(name, Comparison(titles, starts, "all", found["alpha"], stop_early=False, episodes=episodes))


def read_check(improvement: Improvement) -> dict[str, Any]:
    """Read what the world model says of recorded episodes."""
    return read_json(improvement.out / "check" / "metrics.json")


def read_gate(improvement: Improvement) -> dict[str, Any] | None:
    """Read what the gate found before RL; None if there was none."""
    records = sorted((improvement.out / "rl" / SuccessGate.name).glob(f"*/{RECORD_FILE}"))
    return read_json(records[-1]) if records else None


def read_selection(improvement: Improvement) -> dict[int, Record]:
    """Read how successful RL's checkpoints were in the real environment, by iteration; nothing without
    selection."""
    folders = (improvement.out / "rl" / Selection.name).glob(f"*/{RECORD_FILE}")
    return {int(path.parent.name): read_json(path) for path in folders}


def read_choice(improvement: Improvement) -> Place | None:
    """Read the comparison that chooses the policy to use; None without selection."""
    real = improvement.config.real_env
    if real is None or not improvement.config.selects:
        return None
    return read_place(f"in {real.type}", improvement.out / "choice", [*improvement.policies])


def training_curves(improvement: Improvement) -> dict[str, Curve]:
    """Read losses, and what RL logs, by title."""
    out = improvement.out
    found = {title: curve(read_metrics(out / folder), "loss") for folder, title in MODELS.items()}
    if improvement.clones:
        found["Further BC"] = lerobot_train_curve(out / "logs" / "cloned.log")
    runs = {"rl": str(improvement.config.algorithm["algorithm.type"])}
    runs |= {"distilled": "distillation"} if improvement.has_distilled else {}
    for folder, algorithm in runs.items():
        rows = read_metrics(out / folder)
        found |= {title: curve(rows, column, ITERATION) for column, title in PANELS[algorithm].items()}
    return {title: each for title, each in found.items() if each.x}


def curve(metrics: Sequence[Mapping[str, Any]], name: str, unit: str = STEP) -> Curve:
    """Return a column of a metrics file without rows that lack it."""
    rows = [(row["step"], row[name]) for row in metrics if isinstance(row.get(name), int | float)]
    return Curve([float(step) for step, _ in rows], [float(value) for _, value in rows], unit)


def lerobot_train_curve(log: Path, name: str = "loss") -> Curve:
    """Read the log lines of lerobot-train, `… step:200 … loss:0.123 …`: it keeps its numbers nowhere else.

    It writes steps from 1,000 on as thousands (`1K`): the values of each are averaged.
    """
    found: dict[float, list[float]] = {}
    for step, value in re.findall(rf"step:(\d+K?)\b.*?\b{name}:([-\d.e]+)", log.read_text(errors="replace")):
        at = float(step.rstrip("K")) * (1000 if step.endswith("K") else 1)
        found.setdefault(at, []).append(float(value))
    return Curve(sorted(found), [float(np.mean(found[step])) for step in sorted(found)])


def read_json(path: Path) -> dict[str, Any]:
    """Read what a stage wrote."""
    found: dict[str, Any] = json.loads(path.read_text())
    return found
