"""The figure of what imagination is worth: success of each method for every budget."""

from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from experiments.page.cells import DOMAINS, Load
from experiments.page.value_cells import IMAGINED, SCENES, TITLES, Groups, groups, measured, outcomes
from lerobot_wmrl.common.statistics import RunsMean
from lerobot_wmrl.improve.report.figures import tidy

DRAWN: Final = {
    "cloning": "#90a4ae",
    "filtered": "#607d8b",
    "longer_filtered": "#37474f",
    "simulated_ppo": "#2f855a",
    "imagined_ppo": "#f6ad55",
    "planned": "#dd6b20",
    "ppo_distilled": "#9b2c2c",
}
"""Methods of the figure, the main ones of the table, and their colours."""


def draw_value(load: Load, path: Path) -> None:
    """Draw success for every budget: a panel a domain, a point a method with its interval.

    Nothing is drawn before a cell has been published.
    """
    found = groups(load)
    if not found:
        return
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    methods = measured([cell for cells in found.values() for cell in cells], DRAWN)
    for axes, domain in zip(panels, SCENES, strict=True):
        points = [
            _draw_points(axes, found, method, domain, 0.11 * (number - (len(methods) - 1) / 2))
            for number, method in enumerate(methods)
        ]
        axes.set_title(f"{DOMAINS[domain]} scenes")
        axes.set_xlabel("episodes in ManiSkill: demonstrations + rollouts")
        axes.set_xticks(range(len(found)), [f"{d} + {r}" for d, r in sorted(found)])
    panels[0].set_ylabel("success in ManiSkill")
    titles = [TITLES[method] for method in methods]
    figure.legend(points, titles, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    tidy(figure).savefig(path, dpi=130)


def _draw_points(axes: Axes, found: Groups, method: str, domain: str, shift: float) -> ErrorbarContainer:
    """Draw a method's mean and interval beside those of others: hollow if it uses no world model."""
    places, means = [], []
    for place, budget in enumerate(sorted(found)):
        if runs := outcomes(found[budget], method, domain):
            places.append(place + shift)
            means.append(RunsMean.over(runs))
    whiskers = [[mean.mean - mean.low for mean in means], [mean.high - mean.mean for mean in means]]
    return axes.errorbar(
        places,
        [mean.mean for mean in means],
        whiskers,
        fmt="o",
        color=DRAWN[method],
        markerfacecolor=DRAWN[method] if method in IMAGINED else "white",
    )
