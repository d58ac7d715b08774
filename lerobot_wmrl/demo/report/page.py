"""The demo's page: `summary.json` and a self-contained `report.html` from a finished output folder."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.common.files import write_json, write_text
from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.demo.report import figures, results
from lerobot_wmrl.demo.report.results import BASELINE, EPISODES, IMPROVED, Rates, Summary
from lerobot_wmrl.demo.stages import MEASURED, WHERE, DemoConfig, drive
from lerobot_wmrl.maniskill.recordings import recorded_episodes

SIGNIFICANCE = 0.05

POLICY_TITLES = {
    "cloned": "cloned from the demonstrations",
    "filtered": "cloned with successful rollouts",
    "rl": "PPO in imagination",
    "distilled": "PPO, then fitted to a planner",
}
"""What each policy learnt from, under its bars."""

PLACES = {"known": "known scenes", "unseen": "unseen scenes", "imagined": "in the world model"}
"""Where success is measured, as the figure says it."""

PICTURE_SECTIONS = (
    (
        "comparison",
        "Recorded beside imagined",
        "The same episode twice, from the same first frame and with the same actions: above as it was "
        "recorded, below as the world model imagined it.",
    ),
    (
        "goal",
        "Goal frames",
        "What the text world model expects the scene to look like when the task is done. The reward measures "
        "how close an imagined frame comes to it.",
    ),
    (
        "reward",
        "The reward along recorded episodes",
        "A successful and a failed episode, with the reward that the world models give each frame.",
    ),
    (
        "accuracy",
        "How long the imagination stays true",
        "The distance between imagined and recorded frames, by the number of frames imagined so far.",
    ),
)
"""Start of the pictures' file names, heading, and what to look for."""


def write_report(config: DemoConfig, stages: Sequence[str]) -> Path:
    """Write summary.json and report.html from what the stages left; return the page."""
    records = results.stage_records(config.output_dir, stages)
    rates = results.policy_rates(config.output_dir)
    table = recorded_episodes(config.output_dir / "dataset")
    summary = results.summarize(config, rates, table, records)
    write_json(config.output_dir / "summary.json", summary)
    page = config.output_dir / "report.html"
    write_text(page, render(config, rates, summary, table, records))
    return page


def render(
    config: DemoConfig, rates: Rates, summary: Summary, table: dict[str, np.ndarray],
    records: list[dict[str, Any]],
) -> str:  # fmt: skip
    """Fill the template, with every picture inside the page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lerobot_wmrl.demo.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("template.html").render(
        task="push an object forward",
        preset=config.stage_preset,
        seed=config.seed,
        episodes=summary["dataset"],
        minutes=round(summary["seconds"] / 60, 1),
        peak_memory=f"{summary['peak_memory_bytes'] / 1e9:.1f}",
        demonstrations=config.demonstrations,
        rollouts=config.rollouts,
        cards=headline_cards(rates),
        verdicts=run_verdicts(config.output_dir, rates),
        bars=figures.success_bars(
            {POLICY_TITLES[policy]: {PLACES[p]: r for p, r in row.items()} for policy, row in rates.items()}
        ),
        trust=trust_rows(config.output_dir),
        warning=results.gate_warning(config.output_dir / "rl"),
        pictures=picture_sections(config.output_dir),
        curves=[
            figures.curves(lines, title, xlabel="iteration" if title.startswith("PPO") else "step")
            for title, lines in results.training_curves(config.output_dir).items()
        ],
        drive=shlex.join(drive(config)),
        runs=results.other_seeds(config),
        kinds=kind_rows(table),
        stages=records,
    )


def run_verdicts(output_dir: Path, rates: Rates) -> list[str]:
    """State, for known and for unseen scenes, what PPO and a planner in imagination added."""
    return [
        verdict(
            where, rates[BASELINE][where], rates[IMPROVED][where], results.paired_change(output_dir, where)
        )
        for where in WHERE
    ]


def verdict(where: str, before: Proportion, after: Proportion, change: PairedChange) -> str:
    """State whether success in ManiSkill changed, judged on the same starts; nothing more is claimed."""
    said = (
        f"In {where} scenes PPO and a planner in the world model brought success in ManiSkill from "
        f"{100 * before.share:.0f} % to {100 * after.share:.0f} % "
        f"({100 * (after.share - before.share):+.0f} points): "
        f"of the same {before.n} starts, {change.gained} were gained and {change.lost} lost "
        f"(exact McNemar test: p = {change.p_value:.2g})."
    )
    if change.p_value >= SIGNIFICANCE:
        return f"{said} This run alone does not show a difference."
    better = "better" if change.gained > change.lost else "worse"
    return f"{said} It is {better} than cloning the same data's successes."


def conclusion(config: DemoConfig, page: Path) -> str:
    """Say in a few lines what the demo made, how good it is, and what comes next."""
    out = config.output_dir
    found = results.replayed(out, BASELINE)
    false_positives, recall = found["false_positive_rate"], found["recall"]
    lines = [
        f"Made: a dataset, a frame tokenizer, two world models and four policies in {out}.",
        *run_verdicts(out, results.policy_rates(out)),
        f"Of held-out episodes of the {MEASURED[BASELINE]}, the world model predicts {false_positives.k} of "
        f"{false_positives.n} failures as successes (false positives) and {recall.k} of {recall.n} successes "
        "(recall).",
        f"Report: {page}",
        "Next: open the report; it ends with every command, to change and run by hand. Run the demo with "
        "--seed=1 and an --output_dir beside this one, and its report compares both. Drive the world model:",
        shlex.join(drive(config)),
    ]
    return "\n".join(lines)


def headline_cards(rates: Rates) -> list[dict[str, Any]]:
    """Return one card for each policy's success in ManiSkill, known scenes first."""
    cards = []
    for where in WHERE:
        for policy, row in rates.items():
            rate = row[where]
            value = "–" if math.isnan(rate.share) else f"{100 * rate.share:.0f} %"
            cards.append({"label": f"{PLACES[where]}: {POLICY_TITLES[policy]}", "value": value, "n": rate.n,
                          "note": f"{rate.k} of {rate.n}; 95 %: {100 * rate.interval[0]:.0f}–"
                                  f"{100 * rate.interval[1]:.0f} %"})  # fmt: skip
    return cards


def trust_rows(output_dir: Path) -> list[dict[str, str]]:
    """Return false positives and recall for each source of episodes."""
    rows = []
    for suffix, whose in EPISODES.items():
        replayed = results.replayed(output_dir, suffix)
        rows.append({"episodes": whose, **{key: str(rate) for key, rate in replayed.items()}})
    return rows


def kind_rows(table: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Count the episodes and the successes of each kind."""
    return [
        {"kind": KINDS[kind].replace("_", " "), "n": int((table["kind"] == kind).sum()),
         "successes": int(table["success"][table["kind"] == kind].sum())}
        for kind in np.unique(table["kind"])
    ]  # fmt: skip


def picture_sections(output_dir: Path) -> list[dict[str, Any]]:
    """Collect the pictures of the replays by section, `replay_<whose>/<section>*.png|gif`."""
    sections = []
    for stem, title, text in PICTURE_SECTIONS:
        images = [
            {"url": figures.picture(path), "caption": f"{whose}: {path.stem.replace('_', ' ')}"}
            for suffix, whose in EPISODES.items()
            for path in sorted((output_dir / f"replay_{suffix}").glob(f"{stem}*"))
            if path.suffix in (".png", ".gif")
        ]
        if images:
            sections.append({"title": title, "text": text, "images": images})
    return sections
