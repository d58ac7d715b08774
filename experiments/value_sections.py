"""What imagination is worth: its section of docs/results.md, and the figure, from published cells."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.cells import DOMAINS, Load, points, table
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.statistics import RunsMean
from lerobot_wmrl.demo.report.figures import COLOURS, tidy

TITLES: Final = {
    "cloning": "cloning of the demonstrations",
    "filtered": "cloning of demonstrations and successful rollouts",
    "weighted": "advantage-weighted cloning (RA-BC)",
    "conditioned": "advantage-conditioned cloning (RECAP)",
    "imagined_ppo": "PPO in imagination",
    "distilled": "planner distilled in imagination",
}
"""Methods in the order of the table."""

IMAGINED: Final = ("imagined_ppo", "distilled")
"""Methods that use a world model."""

RIVALS: Final = tuple(method for method in TITLES if method not in IMAGINED)
"""Methods that use none."""

Cell = dict[str, Any]
Groups = dict[tuple[int, int], list[Cell]]
"""Cells, one a seed, by demonstrations and rollouts."""


def groups(load: Load, study: str) -> Groups:
    """Return the published cells of a study."""
    found: Groups = {}
    for each in read_cells(ROOT / "experiments" / f"{study}.yaml"):
        try:
            cell = load(f"{study}/{each.variables['cell']}")
        except FileNotFoundError:
            continue
        found.setdefault((cell["demonstrations"], cell["rollouts"]), []).append(cell)
    return found


def outcomes(cells: Sequence[Cell], method: str, domain: str) -> list[list[int]]:
    """Return the outcomes of a method's runs on the same starts, (R, E)."""
    return [cell["methods"][method][domain]["outcomes"] for cell in cells]


def gain(cells: Sequence[Cell], method: str, rival: str, domain: str) -> RunsMean:
    """Return how much more often a method succeeds than a rival on the same data and starts."""
    pairs = zip(outcomes(cells, method, domain), outcomes(cells, rival, domain), strict=True)
    return RunsMean.over([[a - b for a, b in zip(*pair, strict=True)] for pair in pairs])


def best(cells: Sequence[Cell], methods: Sequence[str], domain: str) -> str:
    """Return the method with the highest mean success."""
    return max(methods, key=lambda method: RunsMean.over(outcomes(cells, method, domain)).mean)


def value_push(load: Load) -> str:
    """Return the section: for each budget the best with and without a world model, and a table."""
    found = groups(load, "value_push")
    answers, rows = [], []
    for (demonstrations, rollouts), cells in found.items():
        for domain in ("ind", "ood"):
            ours, rival = (best(cells, methods, domain) for methods in (IMAGINED, RIVALS))
            gained = points(asdict(gain(cells, ours, rival, domain)))
            answers.append([demonstrations, rollouts, DOMAINS[domain], TITLES[rival], TITLES[ours], gained])
        rows += [
            [demonstrations, rollouts, title, *(shares(cells, method, domain) for domain in ("ind", "ood")),
             f"{sum(cell['methods'][method]['minutes'] for cell in cells) / len(cells):.0f}"]
            for method, title in TITLES.items()
        ]  # fmt: skip
    budget = ["demonstrations", "rollouts"]
    starts = len(outcomes(next(iter(found.values())), "cloning", "ind")[0])
    return f"""The best method with a world model against the best without one, on the same real episodes and
starts:

{table([*budget, "scenes", "best without", "best with", "gain"], answers)}

All methods:

{table([*budget, "method", "known scenes", "unseen scenes", "minutes"], rows)}

Success of each seed over {starts} starts; with more than one seed, their mean. Intervals count starts, and
seeds where there are several. Minutes are those of training on one core, without recording. The better of
several methods is chosen on the starts that are reported, among four rivals and two methods of ours.

![Success against real episodes](images/value_push.png)"""


def shares(cells: Sequence[Cell], method: str, domain: str) -> str:
    """`62, 60 → 61 % (57–65)`, or `62 % (57–67)` of one seed."""
    found = outcomes(cells, method, domain)
    mean = RunsMean.over(found)
    each = ", ".join(f"{100 * sum(run) / len(run):.0f}" for run in found)
    seeds = f"{each} → " if len(found) > 1 else ""
    return f"{seeds}{100 * mean.mean:.0f} % ({100 * mean.low:.0f}–{100 * mean.high:.0f})"


def draw_value(load: Load, study: str, path: Path) -> None:
    """Draw success against real episodes: a panel a domain, a line a method with its band.

    Nothing is drawn before a cell has been published.
    """
    found = groups(load, study)
    if not found:
        return
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, domain in zip(panels, ("ind", "ood"), strict=True):
        for colour, (method, title) in zip((*COLOURS, "#b83280", "#333333"), TITLES.items(), strict=True):
            _draw_line(axes, found, method, domain, {"color": colour, "label": title})
        axes.set_title(f"{DOMAINS[domain]} scenes")
        axes.set_xlabel("real episodes: demonstrations + rollouts")
        axes.set_xticks(range(len(found)), [f"{d} + {r}" for d, r in sorted(found, key=sum)])
    panels[0].set_ylabel("success in ManiSkill")
    path.parent.mkdir(parents=True, exist_ok=True)
    tidy(figure).savefig(path, dpi=130)


def _draw_line(axes: Axes, found: Groups, method: str, domain: str, style: Mapping[str, str]) -> None:
    """Draw a method's mean and band over the budgets, the smallest first."""
    means = [RunsMean.over(outcomes(found[budget], method, domain)) for budget in sorted(found, key=sum)]
    axes.plot([mean.mean for mean in means], marker="o", **style)
    axes.fill_between(
        range(len(means)),
        [mean.low for mean in means],
        [mean.high for mean in means],
        color=style["color"],
        alpha=0.15,
    )
