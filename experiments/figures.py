"""Draw the pictures of results in docs/."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.improve.report.figures import COLOURS, tidy

PALETTE: Final = (*COLOURS, "#b83280", "#333333", "#d69e2e", "#319795")
"""Colours of methods, in their order."""

PLACES: Final = {"imagined": "PPO in imagination", "simulated": "PPO in ManiSkill"}
IMPROVEMENT: Final = {"cloned": "SFT", "trained": "PPO in imagination"}
DOMAINS: Final = {"ind": "known scenes", "ood": "unseen scenes", "drawn": "known scenes, tokens drawn"}
CURVES: Final = (("data", "episodes"), ("time", "minutes"), ("size", "parameters"))
"""How the names of a learning curve's trainings begin, and what they are drawn over."""


def draw_comparison(results: Mapping[str, Any], path: Path) -> None:
    """Success in known scenes against steps and against time; a thin line a seed, a thick one their mean."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    units = (
        ("env_steps", 1e-3, "thousand steps of the environment"),
        ("seconds", 1 / 60, "minutes on one core"),
    )
    for axes, (abscissa, unit, label) in zip(panels, units, strict=True):
        _draw_curves(axes, results, abscissa, unit)
        axes.set_xlabel(label)
    panels[0].set_ylabel("success in ManiSkill")
    tidy(figure).savefig(path, dpi=130)


def _draw_curves(axes: Axes, results: Mapping[str, Any], abscissa: str, unit: float) -> None:
    cloned = results["cloned"]["ind"]
    axes.axhspan(*cloned["wilson_95"], color="#999", alpha=0.2)
    axes.axhline(cloned["share"], color="#666", linestyle="--", label="SFT")
    for colour, (place, title) in zip(COLOURS, PLACES.items(), strict=False):
        curves = np.array(
            [
                [(0.0, cloned["share"]), *((point[abscissa] * unit, point["share"]) for point in run["ind"])]
                for run in results["runs"][place]
            ]
        )
        for curve in curves:
            axes.plot(*curve.T, color=colour, alpha=0.35, linewidth=1)
        axes.plot(*curves.mean(0).T, color=colour, marker="o", label=title)


def draw_improvement(found: Mapping[str, Any], path: Path, kinds: Mapping[str, str] = IMPROVEMENT) -> None:
    """Draw success after several kinds of training: a panel a domain, a group of bars a policy or task.

    Args:
        found: domain → `policies` → policy or task → kind → its rate.
        path: of the picture.
        kinds: their titles.
    """
    figure = Figure(figsize=(4 * len(found), 3.2), layout="constrained")
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    width = 0.5 if len(kinds) < 3 else 0.8
    for axes, (domain, numbers) in zip(panels, found.items(), strict=True):
        groups = numbers["policies"]
        for number, (kind, title) in enumerate(kinds.items()):
            for place, row in enumerate(groups.values()):
                rate = Proportion.from_json(row[kind])
                axes.bar(
                    place + width / len(kinds) * number,
                    rate.share,
                    0.88 * width / len(kinds),
                    yerr=rate.whiskers,
                    capsize=3,
                    color=PALETTE[number],
                    label=title if place == 0 and domain == list(found)[-1] else None,
                )
        middle = width / 2 * (1 - 1 / len(kinds))
        axes.set_xticks([place + middle for place in range(len(groups))], list(groups))
        axes.set_title(DOMAINS[domain])
        axes.set_ylim(0, 1 + 0.07 * len(kinds))  # room for the legend
    panels[0].set_ylabel("success in ManiSkill")
    tidy(figure).savefig(path, dpi=130)


def draw_learning_curve(variants: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """A column each for data, time and size: delta-PSNR above, the AUC of the gate below."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    grid = figure.subplots(2, len(CURVES), sharex="col", sharey="row")
    for (above, below), (prefix, amount) in zip(grid.T, CURVES, strict=True):
        rows = [row for name, row in variants.items() if name.startswith(("full", prefix))]
        rows.sort(key=lambda row: row[amount])
        amounts, estimates = [row[amount] for row in rows], [row["delta_psnr_0_6s"] for row in rows]
        values = [each["value"] for each in estimates]
        errors = [[abs(each["value"] - each["bootstrap_95"][side]) for each in estimates] for side in (0, 1)]
        above.errorbar(amounts, values, errors, color=COLOURS[0], marker="o", capsize=3)
        below.plot(amounts, [row["gate"]["auc"] for row in rows], color=COLOURS[1], marker="o")
        below.set_xscale("log")
        below.set_xlabel(amount)
    grid[0, 0].set_ylabel("delta-PSNR after 0.6 s (dB)")
    grid[1, 0].set_ylabel("AUC of the gate")
    tidy(figure).savefig(path, dpi=130)


def draw_judged(found: Mapping[str, Any], path: Path) -> None:
    """A panel a domain: every policy's imagined and real success, those trained in the world model apart."""
    figure = Figure(figsize=(4.4 * len(found), 4), layout="constrained")
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for axes, (domain, numbers) in zip(panels, found.items(), strict=True):
        axes.plot((0, 1), (0, 1), color="#999", linewidth=1, linestyle="--")
        for row in numbers["policies"].values():
            imagined, real = (Proportion.from_json(row[kind]) for kind in ("imagined", "real"))
            axes.errorbar(
                imagined.share,
                real.share,
                real.whiskers,
                imagined.whiskers,
                linewidth=0.7,
                color=COLOURS[1 if row["inside"] else 0],
                marker="x" if row["inside"] else "o",
                markersize=4,
            )
        axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), title=DOMAINS[domain])
        axes.set_xlabel("success in the world model (crosses: trained in it)")
    panels[0].set_ylabel("success in ManiSkill")
    tidy(figure).savefig(path, dpi=110)
