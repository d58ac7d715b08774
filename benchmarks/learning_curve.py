"""What would make the world model better: more data, a larger network or more training?

    python benchmarks/learning_curve.py --dataset.root=outputs/gate/dataset \\
        --rollouts=outputs/gate/rollouts --tokenizer=outputs/gate/frame_tokenizer

One training as the preset says; beside it some with a half and a quarter of the episodes, of the steps, and
with smaller networks, all else alike and each with a whole learning-rate schedule. All are replayed open
loop on held-out episodes and on the rollouts, for the gate. Interrupted, the same command continues; what is
trained and measured is not done again. Writes docs/results/learning_curve.json and a picture beside it.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure

from lerobot_wmrl.common.presets import Flags, preset_settings
from lerobot_wmrl.data.episode_table import open_dataset
from lerobot_wmrl.demo.report.figures import COLOURS, tidy
from world_model_ablation import add_arguments, compare, results_table

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "learning_curve.json"
FULL: Final = "full"
PARTS: Final = {"half": 2, "quarter": 4}
"""Of the episodes, and of the steps."""

SIZES: Final[dict[str, Flags]] = {
    "width_128": {"model.layers": 4, "model.width": 128},
    "width_96": {"model.layers": 3, "model.width": 96},
}
"""Networks below the preset's."""

PANELS: Final = (("data", "episodes"), ("time", "minutes"), ("size", "parameters"))
"""Which rows are drawn beside the full one, by how their names begin, over what."""


def variants(preset: str, steps: int | None, episodes: int) -> dict[str, Flags]:
    """Name → what differs from the full training on `episodes` of them."""
    full = steps or int(preset_settings(preset, "train-world-model", ["action_world_model"])["steps"])
    data = {
        f"data_{name}": {"dataset.episodes": str(list(range(0, episodes, part)))}
        for name, part in PARTS.items()
    }
    time = {f"time_{name}": {"steps": full // part} for name, part in PARTS.items()}
    return {FULL: {}, **data, **time, **{f"size_{name}": flags for name, flags in SIZES.items()}}


def draw(rows: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """A column each for data, time and size: delta-PSNR above and, if the gate was asked, its AUC below."""
    gated = all("gate" in row for row in rows.values())
    figure = Figure(figsize=(9, 5 if gated else 2.6), layout="constrained")
    grid = figure.subplots(1 + gated, len(PANELS), squeeze=False, sharex="col", sharey="row")
    for column, (prefix, amount) in zip(grid.T, PANELS, strict=True):
        shown = [row for name, row in rows.items() if name == FULL or name.startswith(prefix)]
        shown.sort(key=lambda row: row[amount])
        amounts = [row[amount] for row in shown]
        estimates = [row["delta_psnr_15"] for row in shown]
        values = [each["value"] for each in estimates]
        spread = [[abs(each["value"] - each["bootstrap_95"][side]) for each in estimates] for side in (0, 1)]
        column[0].errorbar(amounts, values, spread, color=COLOURS[0], marker="o", capsize=3)
        if gated:
            column[1].plot(amounts, [row["gate"]["auc"] for row in shown], color=COLOURS[1], marker="o")
        column[-1].set_xscale("log")
        column[-1].set_xlabel(amount)
    grid[0, 0].set_ylabel("delta-PSNR at step 15 (dB)")
    if gated:
        grid[1, 0].set_ylabel("AUC of the gate")
    tidy(figure).savefig(path, dpi=130)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_arguments(parser, Path("outputs/learning_curve"), RESULTS)
    given = parser.parse_args()
    episodes = open_dataset(given.dataset_root).num_episodes
    rows = compare(given, variants(given.preset, given.steps, episodes))
    draw(rows, given.output.with_suffix(".png"))
    print(results_table(rows))


if __name__ == "__main__":
    main()
