"""What the trainings of an improvement logged as they went on."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.improve.stage_names import StageName

MODELS = {StageName.TOKENIZER: "Frame tokenizer", StageName.WORLD_MODEL: "World model"}
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


def training_curves(progress: Progress) -> dict[str, Curve]:
    """Read losses, and what RL logs, by title."""
    plan, out = progress.plan, progress.plan.out
    curves = {title: curve(read_metrics(out / folder), "loss") for folder, title in MODELS.items()}
    if plan.clones:
        curves["Further BC"] = lerobot_train_curve(out / "logs" / f"{StageName.CLONED}.log")
    runs = {StageName.RL: str(plan.config.algorithm["algorithm.type"])}
    runs |= {StageName.DISTILLED: "distillation"} if progress.has_distilled else {}
    for folder, algorithm in runs.items():
        rows = read_metrics(out / folder)
        curves |= {title: curve(rows, column, ITERATION) for column, title in PANELS[algorithm].items()}
    return {title: each for title, each in curves.items() if each.x}


def curve(metrics: Sequence[Mapping[str, Any]], name: str, unit: str = STEP) -> Curve:
    """Return a column of a metrics file without rows that lack it."""
    rows = [(row["step"], row[name]) for row in metrics if isinstance(row.get(name), int | float)]
    return Curve([float(step) for step, _ in rows], [float(value) for _, value in rows], unit)


def lerobot_train_curve(log: Path) -> Curve:
    """Read the loss from the log of lerobot-train, `… step:200 … loss:0.123 …`: it keeps it nowhere else.

    It writes steps from 1,000 on as thousands (`1K`): the values of each are averaged.
    """
    values: dict[float, list[float]] = {}
    for step, value in re.findall(r"step:(\d+K?)\b.*?\bloss:([-\d.e]+)", log.read_text(errors="replace")):
        at = float(step.rstrip("K")) * (1000 if step.endswith("K") else 1)
        values.setdefault(at, []).append(float(value))
    return Curve(sorted(values), [float(np.mean(values[step])) for step in sorted(values)])
