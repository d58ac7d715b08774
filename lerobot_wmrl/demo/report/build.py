"""From an output folder of the demo to `summary.json` and `report.html`."""

import math
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.common.files import write_json, write_text
from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.recorded_episodes import recorded_episodes
from lerobot_wmrl.demo.report import figures, runs, sources
from lerobot_wmrl.demo.report.pictures import EPISODES, picture_sections
from lerobot_wmrl.demo.stages import DemoConfig

SIGNIFICANCE = 0.05

POLICIES = {"sft": "cloned policy", "rl": "PPO policy"}


def write_report(config: DemoConfig, stages: list[str]) -> Path:
    """Write both files; returns the page."""
    records = sources.stage_records(config.output_dir, stages)
    measured = measure(config.output_dir)
    table = recorded_episodes(config.output_dir / "dataset")
    write_json(config.output_dir / "summary.json", summary(config, measured, table, records))
    page = config.output_dir / "report.html"
    write_text(page, render(config, measured, table, records))
    return page


def measure(output_dir: Path) -> dict[str, dict[str, Proportion]]:
    """For each policy: real and imagined success, false successes and recognised successes."""
    return {
        policy: {
            "maniskill": sources.success_rate(output_dir / f"eval_{policy}"),
            "imagined": sources.success_rate(output_dir / f"imagine_{policy}"),
            **sources.replayed(output_dir / f"replay_{policy}"),
        }
        for policy in POLICIES
    }


def trust_rows(output_dir: Path) -> list[dict[str, str]]:
    """What the world model says of real episodes, for each source of them."""
    rows = []
    for suffix, whose in EPISODES.items():
        replayed = sources.replayed(output_dir / f"replay_{suffix}")
        rows.append({"episodes": whose, **{key: str(rate) for key, rate in replayed.items()}})
    return rows


def summary(
    config: DemoConfig,
    measured: dict[str, dict[str, Proportion]],
    table: dict[str, np.ndarray],
    records: list[dict[str, Any]],
) -> dict[str, Any]:
    """Every headline number of the run."""
    return {
        "preset": config.stage_preset,
        "seed": config.seed,
        "policies": {policy: {k: v.as_json() for k, v in row.items()} for policy, row in measured.items()},
        "change": sources.real_change(config.output_dir).as_json(),
        "outcomes": {policy: sources.outcomes(config.output_dir / f"eval_{policy}") for policy in POLICIES},
        "dataset": {"episodes": len(table["episode"]), "frames": int(table["length"].sum())},
        "seconds": sum(record["seconds"] for record in records),
        "peak_memory_bytes": max(record["peak_memory_bytes"] for record in records),
        "stages": {
            record["name"]: {key: record[key] for key in ("seconds", "peak_memory_bytes")}
            for record in records
        },
    }


def verdict(before: Proportion, after: Proportion, change: PairedChange) -> str:
    """In plain words whether real success changed, judged on the same starts; no more is claimed."""
    shares = f"from {100 * before.share:.0f} % to {100 * after.share:.0f} %"
    told = (
        f"Real success went {shares} ({100 * (after.share - before.share):+.0f} points): "
        f"of the same {before.n} starts, {change.gained} were gained and {change.lost} lost "
        f"(exact McNemar test: p = {change.p_value:.2g})."
    )
    if change.p_value >= SIGNIFICANCE:
        return f"{told} This run alone does not show a difference."
    if change.gained > change.lost:
        return f"{told} It helped in reality."
    return f"{told} It made the policy worse in reality."


def headline_cards(measured: dict[str, dict[str, Proportion]]) -> list[dict[str, Any]]:
    cards = []
    for policy, row in measured.items():
        for key, where in (("maniskill", "in ManiSkill"), ("imagined", "in the world model")):
            rate = row[key]
            value = "–" if math.isnan(rate.share) else f"{100 * rate.share:.0f} %"
            cards.append({"label": f"{POLICIES[policy]}, {where}", "value": value, "n": rate.n,
                          "note": f"{rate.k} of {rate.n}; 95 %: {100 * rate.interval[0]:.0f}–"
                                  f"{100 * rate.interval[1]:.0f} %"})  # fmt: skip
    return cards


def training_curves(output_dir: Path) -> list[str]:
    """One panel a training command: losses, then what PPO watched."""
    panels = []
    for folder, title in (
        ("frame_tokenizer", "Frame tokenizer"),
        ("action_world_model", "Action world model"),
        ("text_world_model", "Text world model"),
    ):
        lines = sources.metric_curves(read_metrics(output_dir / folder), ["loss"])
        panels.append(figures.curves(lines, title))
    loss = sources.lerobot_train_curve(output_dir / "logs" / "sft.log")
    panels.append(figures.curves({"loss": loss}, "Cloned policy"))
    rows = read_metrics(output_dir / "rl")
    for names, title in sources.PPO_PANELS:
        lines = sources.metric_curves(rows, names)
        if lines:
            panels.append(figures.curves(lines, title, xlabel="iteration"))
    return panels


def other_seeds(config: DemoConfig) -> dict[str, Any] | None:
    """This run and those with other seeds beside it, if there are any that met the same starts."""
    found = [
        run
        for run in runs.finished_runs(config.output_dir, config.stage_preset)
        if len(run["outcomes"]["sft"]) == config.eval_episodes
    ]
    if len(found) < 2:
        return None
    return {"rows": runs.run_rows(found), "change": str(runs.mean_change(found))}


def kind_rows(table: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    return [
        {"kind": KINDS[kind].replace("_", " "), "n": int((table["kind"] == kind).sum()),
         "successes": int(table["success"][table["kind"] == kind].sum())}
        for kind in np.unique(table["kind"])
    ]  # fmt: skip


def render(
    config: DemoConfig,
    measured: dict[str, dict[str, Proportion]],
    table: dict[str, np.ndarray],
    records: list[dict[str, Any]],
) -> str:
    """The page, with everything in it."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lerobot_wmrl.demo.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("template.html").render(
        task="push an object forward",
        preset=config.stage_preset,
        seed=config.seed,
        episodes={"n": len(table["episode"]), "frames": int(table["length"].sum())},
        minutes=round(sum(record["seconds"] for record in records) / 60, 1),
        peak_memory=f"{max(record['peak_memory_bytes'] for record in records) / 1e9:.1f}",
        cards=headline_cards(measured),
        verdict=verdict(
            measured["sft"]["maniskill"], measured["rl"]["maniskill"], sources.real_change(config.output_dir)
        ),
        bars=figures.success_bars(
            {POLICIES[p]: (r["maniskill"], r["imagined"]) for p, r in measured.items()}
        ),
        trust=trust_rows(config.output_dir),
        warning=sources.gate_warning(config.output_dir / "rl"),
        pictures=picture_sections(config.output_dir),
        curves=training_curves(config.output_dir),
        runs=other_seeds(config),
        kinds=kind_rows(table),
        stages=records,
    )
