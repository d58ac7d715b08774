"""Several runs of the demo in one table and one picture: what it gained, run by run.

    python benchmarks/demo_seeds.py outputs/demo-0 outputs/demo-1 outputs/demo-2

Reads each run's summary.json; writes docs/results/demo.json and docs/results/demo.png.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.demo.report.figures import IMAGINED, REAL, tidy
from lerobot_wmrl.demo.report.runs import Summary, mean_change, rate, run_rows

RESULTS = Path(__file__).parents[1] / "docs" / "results"


def results(runs: list[Summary]) -> dict[str, Any]:
    """Every run, and what they agree on."""
    return {"change": asdict(mean_change(runs)), "runs": runs}


def draw(summaries: list[Summary], path: Path) -> None:
    """One panel a place: a line from the cloned to the PPO policy for each run, with Wilson intervals."""
    figure = Figure(figsize=(8, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, key, title, colour in zip(
        panels,
        ("maniskill", "imagined"),
        ("in ManiSkill", "in the world model"),
        (REAL, IMAGINED),
        strict=True,
    ):
        for offset, summary in enumerate(summaries):
            rates = [rate(summary, policy, key) for policy in ("sft", "rl")]
            places = [place + 0.04 * offset for place in (0, 1)]
            shares = [each.share for each in rates]
            below = [each.share - each.interval[0] for each in rates]
            above = [each.interval[1] - each.share for each in rates]
            alpha = 1 - 0.6 * offset / len(summaries)
            axes.errorbar(places, shares, [below, above], color=colour, alpha=alpha, marker="o",
                          capsize=3, label=f"seed {summary['seed']}")  # fmt: skip
        axes.set_title(title)
        axes.set_xticks((0, 1), ("cloned", "PPO"))
        axes.set_ylim(0, 1.05)
    panels[0].set_ylabel("success rate")
    tidy(figure).savefig(path, dpi=130, bbox_inches="tight")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, help="output folders of finished demos")
    runs = parser.parse_args().runs
    missing = [str(run) for run in runs if not (run / "summary.json").is_file()]
    if missing:
        parser.error(f"no summary.json in {', '.join(missing)}: finish the demo there first")
    summaries = [json.loads((run / "summary.json").read_text()) for run in runs]
    write_json(RESULTS / "demo.json", results(summaries))
    draw(summaries, RESULTS / "demo.png")
    for row in run_rows(summaries):
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    print(f"real success changed by {mean_change(summaries)}")


if __name__ == "__main__":
    main()
