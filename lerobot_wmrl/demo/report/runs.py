"""Runs of the demo that differ in their seed, side by side, and the change they agree on."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.statistics import MeanChange, PairedChange, Proportion

Summary = dict[str, Any]


def finished_runs(output_dir: Path, preset: str) -> list[Summary]:
    """Summaries of the finished demos of this size in the folder of `output_dir`, by seed; of two runs with
    the same seed the one in `output_dir` counts, else the first by name."""
    found: dict[int, Summary] = {}
    folders = sorted(path.parent for path in output_dir.absolute().parent.glob("*/summary.json"))
    for folder in sorted(folders, key=lambda folder: folder != output_dir.absolute()):
        summary = json.loads((folder / "summary.json").read_text())
        if summary.get("preset") == preset and "outcomes" in summary:
            found.setdefault(summary["seed"], summary)
    return [found[seed] for seed in sorted(found)]


def mean_change(runs: Sequence[Summary]) -> MeanChange:
    """Of real success from the cloned to the PPO policy. ValueError if the runs met different starts."""
    outcomes = [run["outcomes"] for run in runs]
    return MeanChange.over_runs([each["sft"] for each in outcomes], [each["rl"] for each in outcomes])


def rate(run: Summary, policy: str, key: str) -> Proportion:
    """One of a run's measured shares."""
    measured = run["policies"][policy][key]
    return Proportion(measured["k"], measured["n"])


def run_rows(runs: Sequence[Summary]) -> list[dict[str, str]]:
    """One row a run, as text."""
    rows = []
    for run in runs:
        change = PairedChange(run["change"]["gained"], run["change"]["lost"])
        row = {"seed": str(run["seed"]), "change": str(change)}
        for key in ("maniskill", "imagined"):
            row[key] = " → ".join(f"{100 * rate(run, policy, key).share:.0f} %" for policy in ("sft", "rl"))
        false, recognised = (rate(run, "sft", key) for key in ("false_positive_rate", "recall"))
        row["false_positive_rate"] = f"{false.k} of {false.n}"
        row["recall"] = f"{recognised.k} of {recognised.n}"
        rows.append(row)
    return rows
