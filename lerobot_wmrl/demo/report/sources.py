"""Reads what the commands wrote: success rates, training curves, stage records."""

import json
import re
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.statistics import PairedChange, Proportion

Curve = tuple[list[float], list[float]]
"""Steps and values."""


def outcomes(eval_dir: Path) -> list[bool]:
    """From lerobot-eval's `eval_info.json`: one success a held-out episode, in the order of their seeds."""
    info = json.loads((eval_dir / "eval_info.json").read_text())
    return [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]


def success_rate(eval_dir: Path) -> Proportion:
    """Share of successful episodes."""
    successes = outcomes(eval_dir)
    return Proportion(sum(successes), len(successes))


def real_change(output_dir: Path) -> PairedChange:
    """From the cloned to the PPO policy, on the same held-out starts in the simulator."""
    return PairedChange.between(outcomes(output_dir / "eval_sft"), outcomes(output_dir / "eval_rl"))


def lerobot_train_curve(log: Path, name: str = "loss") -> Curve:
    """lerobot-train's own log lines, `… step:200 … loss:0.123 …`; it keeps its numbers nowhere else.

    After a resume the later line of a step wins.
    """
    found: dict[float, float] = {}
    for step, value in re.findall(rf"step:(\d+K?)\b.*?\b{name}:([-\d.e]+)", log.read_text(errors="replace")):
        found[float(step.rstrip("K")) * (1000 if step.endswith("K") else 1)] = float(value)
    return sorted(found), [found[step] for step in sorted(found)]


def metric_curves(metrics: list[dict[str, Any]], names: list[str]) -> dict[str, Curve]:
    """The named columns of a metrics file, those that are there."""
    curves: dict[str, Curve] = {}
    for name in names:
        rows = [(row["step"], row[name]) for row in metrics if isinstance(row.get(name), int | float)]
        if rows:
            curves[name] = ([float(step) for step, _ in rows], [float(value) for _, value in rows])
    return curves


def gate_warning(training_dir: Path) -> str | None:
    """What the gate last warned of while a policy was trained, if it did."""
    records = sorted((training_dir / "gate").glob("*/record.json"))
    return json.loads(records[-1].read_text())["warning"] if records else None


def stage_records(output_dir: Path, names: list[str]) -> list[dict[str, Any]]:
    """Time, memory and command of each stage, in order."""
    return [json.loads((output_dir / "stages" / f"{name}.json").read_text()) for name in names]


PPO_PANELS = (
    (["success_rate"], "PPO: imagined success"),
    (["reward"], "PPO: reward a step"),
    (["reference_kl"], "PPO: distance from the cloned policy"),
)
"""Columns of the PPO run's metrics file that the report plots, and their titles."""


def replayed(replay_dir: Path) -> dict[str, Proportion]:
    """From the world model's evaluation on real episodes: failures called successes, successes recognised."""
    metrics = json.loads((replay_dir / "metrics.json").read_text())
    return {
        "false_positive_rate": Proportion(metrics["false_positives"], metrics["failures"]),
        "recall": Proportion(metrics["true_positives"], metrics["successes"]),
    }
