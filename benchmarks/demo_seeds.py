"""Several runs of the demo in one table and one picture: what it gained, run by run.

    python benchmarks/demo_seeds.py outputs/demo-0 outputs/demo-1 outputs/demo-2

Reads each run's summary.json; writes docs/results/demo.json and docs/results/demo.png.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lerobot_wmrl.files import write_json
from lerobot_wmrl.report.figures import IMAGINED, REAL, tidy
from lerobot_wmrl.statistics import PairedChange, Proportion

RESULTS = Path(__file__).parents[1] / "docs" / "results"


def pooled(summaries: list[dict[str, Any]], policy: str, key: str) -> Proportion:
    """Episodes of all runs counted together."""
    rates = [summary["policies"][policy][key] for summary in summaries]
    return Proportion(sum(rate["k"] for rate in rates), sum(rate["n"] for rate in rates))


def results(summaries: list[dict[str, Any]]) -> dict[str, Any]:
    """Every run, and all of them pooled."""
    first = summaries[0]["policies"]
    together = {
        policy: {key: pooled(summaries, policy, key).as_json() for key in first[policy]} for policy in first
    }
    changes = [summary["real_change"] for summary in summaries]
    change = PairedChange(*(sum(each[key] for each in changes) for key in ("gained", "lost")))
    return {"pooled": {**together, "real_change": change.as_json()}, "runs": summaries}


def draw(summaries: list[dict[str, Any]], path: Path) -> None:
    """One panel a place: a line from the cloned to the PPO policy for each run, with Wilson intervals."""
    figure = Figure(figsize=(8, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, key, title, colour in zip(
        panels, ("real", "imagined"), ("in ManiSkill", "in the world model"), (REAL, IMAGINED), strict=True
    ):
        for offset, summary in enumerate(summaries):
            rates = [Proportion(**{k: summary["policies"][p][key][k] for k in "kn"}) for p in ("sft", "rl")]
            places = [place + 0.04 * offset for place in (0, 1)]
            shares = [rate.share for rate in rates]
            below = [rate.share - rate.interval[0] for rate in rates]
            above = [rate.interval[1] - rate.share for rate in rates]
            axes.errorbar(places, shares, [below, above], color=colour, alpha=1 - 0.25 * offset, marker="o",
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
    together = results(summaries)["pooled"]
    print("real change:", together.pop("real_change"))
    for policy, row in together.items():
        print(policy, *(f"{key} {rate['k']}/{rate['n']}" for key, rate in row.items()))


if __name__ == "__main__":
    main()
