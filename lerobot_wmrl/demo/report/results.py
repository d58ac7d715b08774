"""Results of a demo, read from what its commands wrote: success rates, training curves, other seeds."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_wmrl.common.statistics import MeanChange, PairedChange, Proportion
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.demo.stages import MEASURED, WHERE, DemoConfig

BASELINE, IMPROVED = "filtered", "distilled"
"""The policy that PPO begins with, which has used the same data without a world model; and the last one."""

EPISODES = {
    IMPROVED: MEASURED[IMPROVED],
    BASELINE: MEASURED[BASELINE],
    "held_out": "recorded, held out from training",
}
"""Whose episodes were replayed, by the suffix of the folder."""

MODELS = {
    "frame_tokenizer": "Frame tokenizer",
    "action_world_model": "Action world model",
    "text_world_model": "Text world model",
}

PPO_PANELS = {
    "success_rate": "PPO: imagined success",
    "reward": "PPO: reward a step",
    "reference_kl": "PPO: KL to the reference policy",
}
"""Columns of the PPO run's metrics that the report plots, and their titles."""

Curve = tuple[list[float], list[float]]
"""Steps and values."""

Rates = dict[str, dict[str, Proportion]]
"""For each policy: success in `known` and `unseen` scenes of ManiSkill, and `imagined`."""

Summary = dict[str, Any]
"""Content of summary.json."""


def policy_rates(output_dir: Path) -> Rates:
    """Read the success of each policy."""
    return {
        policy: {
            **{where: success_rate(output_dir / f"eval_{where}_{policy}") for where in WHERE},
            "imagined": success_rate(output_dir / f"imagine_{policy}"),
        }
        for policy in MEASURED
    }


def outcomes(eval_dir: Path) -> list[bool]:
    """Read the success of each held-out episode, in the order of their seeds, that lerobot-eval wrote."""
    info = json.loads((eval_dir / "eval_info.json").read_text())
    return [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]


def success_rate(eval_dir: Path) -> Proportion:
    """Read the share of successful episodes."""
    successes = outcomes(eval_dir)
    return Proportion(sum(successes), len(successes))


def replayed(output_dir: Path, whose: str) -> dict[str, Proportion]:
    """Read false positives and recall from the world model's evaluation on recorded episodes."""
    metrics = json.loads((output_dir / f"replay_{whose}" / "metrics.json").read_text())
    return {
        "false_positive_rate": Proportion(metrics["false_positives"], metrics["failures"]),
        "recall": Proportion(metrics["true_positives"], metrics["successes"]),
    }


def paired_change(output_dir: Path, where: str) -> PairedChange:
    """Compare the last policy with the one that PPO began with, on the same held-out starts in ManiSkill."""
    before, after = (outcomes(output_dir / f"eval_{where}_{policy}") for policy in (BASELINE, IMPROVED))
    return PairedChange.between(before, after)


def training_curves(output_dir: Path) -> dict[str, dict[str, Curve]]:
    """Read the lines of each panel, by title: losses, then what PPO logs."""
    panels = {
        title: metric_curves(read_metrics(output_dir / folder), ["loss"]) for folder, title in MODELS.items()
    }
    for folder in ("cloned", BASELINE):
        log = output_dir / "logs" / f"{folder}.log"
        panels[MEASURED[folder].capitalize()] = {"loss": lerobot_train_curve(log)}
    rows = read_metrics(output_dir / "rl")
    ppo = {title: metric_curves(rows, [name]) for name, title in PPO_PANELS.items()}
    return panels | {title: lines for title, lines in ppo.items() if lines}


def lerobot_train_curve(log: Path, name: str = "loss") -> Curve:
    """Read the log lines of lerobot-train, `… step:200 … loss:0.123 …`: it keeps its numbers nowhere else.

    After a resume the later line of a step wins.
    """
    found: dict[float, float] = {}
    for step, value in re.findall(rf"step:(\d+K?)\b.*?\b{name}:([-\d.e]+)", log.read_text(errors="replace")):
        found[float(step.rstrip("K")) * (1000 if step.endswith("K") else 1)] = float(value)
    return sorted(found), [found[step] for step in sorted(found)]


def metric_curves(metrics: list[dict[str, Any]], names: list[str]) -> dict[str, Curve]:
    """Return the named columns of a metrics file, without those that are missing."""
    curves: dict[str, Curve] = {}
    for name in names:
        rows = [(row["step"], row[name]) for row in metrics if isinstance(row.get(name), int | float)]
        if rows:
            curves[name] = ([float(step) for step, _ in rows], [float(value) for _, value in rows])
    return curves


def gate_warning(training_dir: Path) -> str | None:
    """Read the gate's last warning while a policy was trained, None without one."""
    records = sorted((training_dir / "gate").glob("*/record.json"))
    return json.loads(records[-1].read_text())["warning"] if records else None


def stage_records(output_dir: Path, names: Sequence[str]) -> list[dict[str, Any]]:
    """Read time, memory and command of each stage, in order."""
    return [json.loads((output_dir / "stages" / f"{name}.json").read_text()) for name in names]


def summarize(
    config: DemoConfig, rates: Rates, table: dict[str, np.ndarray], records: list[dict[str, Any]]
) -> Summary:
    """Collect every headline number of the run, for summary.json."""
    return {
        "preset": config.stage_preset,
        "seed": config.seed,
        "policies": {policy: {k: v.as_json() for k, v in row.items()} for policy, row in rates.items()},
        "changes": {where: paired_change(config.output_dir, where).as_json() for where in WHERE},
        "replayed": {
            whose: {name: share.as_json() for name, share in replayed(config.output_dir, whose).items()}
            for whose in EPISODES
        },
        "outcomes": {
            where: {policy: outcomes(config.output_dir / f"eval_{where}_{policy}") for policy in MEASURED}
            for where in WHERE
        },
        "dataset": {"episodes": len(table["episode"]), "frames": int(table["length"].sum())},
        "seconds": sum(record["seconds"] for record in records),
        "peak_memory_bytes": max(record["peak_memory_bytes"] for record in records),
        "stages": {
            record["name"]: {key: record[key] for key in ("seconds", "peak_memory_bytes")}
            for record in records
        },
    }


def other_seeds(config: DemoConfig) -> dict[str, Any] | None:
    """Compare this run with those beside it that met the same starts, None if there is none."""
    runs = [
        run
        for run in finished_runs(config.output_dir, config.stage_preset)
        if len(run["outcomes"]["known"][IMPROVED]) == config.eval_episodes
    ]
    if len(runs) < 2:
        return None
    return {"rows": run_rows(runs), "changes": {where: str(mean_change(runs, where)) for where in WHERE}}


def finished_runs(output_dir: Path, preset: str) -> list[Summary]:
    """Read the summaries of the finished demos of this size in the folder of `output_dir`, by seed.

    Of two runs with the same seed the one in `output_dir` counts, else the first by name.
    """
    found: dict[int, Summary] = {}
    folders = sorted(path.parent for path in output_dir.absolute().parent.glob("*/summary.json"))
    for folder in sorted(folders, key=lambda folder: folder != output_dir.absolute()):
        summary = json.loads((folder / "summary.json").read_text())
        if summary.get("preset") == preset and MEASURED.keys() == summary["policies"].keys():
            found.setdefault(summary["seed"], summary)
    return [found[seed] for seed in sorted(found)]


def mean_change(runs: Sequence[Summary], where: str) -> MeanChange:
    """Average the change of success in ManiSkill. Raises ValueError if the runs met different starts."""
    both = [run["outcomes"][where] for run in runs]
    return MeanChange.over_runs([each[BASELINE] for each in both], [each[IMPROVED] for each in both])


def run_rows(runs: Sequence[Summary]) -> list[dict[str, str]]:
    """Write a row of text for each run: success of all policies, changes, and the gate's two shares."""
    rows = []
    for run in runs:
        row = {"seed": str(run["seed"])}
        for where in (*WHERE, "imagined"):
            shares = [run["policies"][policy][where]["share"] for policy in MEASURED]
            row[where] = " → ".join(f"{100 * share:.0f} %" for share in shares)
        for where, change in run["changes"].items():
            row[f"change_{where}"] = str(PairedChange(change["gained"], change["lost"]))
        for name, share in run["replayed"][BASELINE].items():
            row[name] = f"{share['k']} of {share['n']}"
        rows.append(row)
    return rows
