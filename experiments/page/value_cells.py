"""What imagination is worth: the published cells, and what they say of each method."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from experiments.page.cells import Load, paired
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.statistics import PairedChange, RunsMean

TITLES: Final = {
    "cloning": "BC of the demonstrations",
    "longer": "BC of the demonstrations, three times as many steps",
    "filtered": "filtered BC: demonstrations and successful rollouts",
    "longer_filtered": "filtered BC, three times as many steps",
    "noiseless": "filtered BC, rollouts without exploration noise",
    "longer_noiseless": "filtered BC, rollouts without exploration noise, three times as many steps",
    "iterated": "filtered BC, rollouts in three rounds, last policy three times as many steps",
    "weighted": "advantage-weighted BC (RA-BC)",
    "conditioned": "advantage-conditioned BC (RECAP)",
    "simulated_ppo": "PPO in ManiSkill, as many episodes of full length as rollouts",
    "imagined_ppo": "PPO in imagination",
    "planned": "PPO in imagination, then planning in it at test time",
    "dyna": "PPO in imagination, with rollouts in three rounds (Dyna)",
    "iterated_ppo": "filtered BC, rollouts in three rounds, then PPO in imagination",
    "iterated_ppo_distilled": "filtered BC, rollouts in three rounds, PPO in imagination, planner distilled",
    "imagined_cloning": "BC of recorded and imagined successes",
    "distilled": "planner distilled in imagination",
    "distilled_ppo": "planner distilled, then PPO in imagination",
    "ppo_distilled": "PPO in imagination, then the planner distilled",
    "longer_imagined_ppo": "PPO in imagination, from the longer BC",
    "longer_ppo_distilled": "PPO in imagination, from the longer BC, then the planner distilled",
    "discounted_ppo": "PPO in imagination, discount 0.989",
    "longer_discounted_ppo": "PPO in imagination, discount 0.989, from the longer BC",
}
"""Methods in the order of the table."""

IMAGINED: Final = (
    "imagined_ppo",
    "planned",
    "dyna",
    "iterated_ppo",
    "iterated_ppo_distilled",
    "imagined_cloning",
    "distilled",
    "distilled_ppo",
    "ppo_distilled",
    "longer_imagined_ppo",
    "longer_ppo_distilled",
    "discounted_ppo",
    "longer_discounted_ppo",
)
"""Methods that use a world model."""

BASELINES: Final = tuple(method for method in TITLES if method not in IMAGINED)
"""Methods that use none."""

REAL_EPISODES: Final = ("demonstrations", "rollouts")
BUDGET: Final = (*REAL_EPISODES, "seed")
SCENES: Final = ("ind", "ood")
"""Where success is measured: in known and in unseen scenes."""

STUDY: Final = "value_push"
PARTS: Final = (
    "value_longer",
    "value_longer_imagined",
    "value_without_noise",
    "value_others",
    "value_iterated",
    "value_simulator",
    "value_dyna",
    "value_imagined",
    "value_distilled_ppo",
    "value_ppo_distilled",
)
"""Studies whose cells add methods to its table."""

SECOND_STUDY: Final = "value_pick_place"
SECOND_PARTS: Final = (
    "value_pick_place_longer_imagined",
    "value_pick_place_discount",
    "value_pick_place_simulator",
    "value_pick_place_dyna",
    "value_pick_place_iterated",
)
"""The same of the second task."""

TASKS_STUDY: Final = "value_tasks"
TASKS_PARTS: Final = ("value_tasks_simulator",)
TASKS_GROUPS: Final = ("task", *REAL_EPISODES)
"""The same of further tasks, and what their cells are grouped by."""

Cell = dict[str, Any]
Groups = dict[tuple[Any, ...], list[Cell]]
"""Cells, one a seed, by what they have in common: demonstrations and rollouts, and the task where there are
several."""


def groups(
    load: Load, study: str = STUDY, parts: Sequence[str] = PARTS, by: Sequence[str] = REAL_EPISODES
) -> Groups:
    """Return the published cells of a study, each with the methods of the same cell of its parts.

    `recorded_anew` tells of each method that learnt from a recording of its own, of the same budget, how many
    episodes of that succeed. Recordings with as many successes are taken for the same.

    Raises:
        ValueError: two studies have the same method in a cell.
    """
    found: Groups = {}
    for each in read_cells(ROOT / "experiments" / f"{study}.yaml"):
        cell, *others = (published(load, name, each.variables["cell"]) for name in (study, *parts))
        if cell:
            whole = {**cell, "methods": {**cell["methods"]}, "recorded_anew": {}}
            for part in (part for part in others if part):
                own = part.get("real_successes")
                for method, row in part["methods"].items():
                    if method in whole["methods"]:
                        raise ValueError(f"{each.variables['cell']}: two studies have {method}")
                    whole["methods"][method] = row
                    whole["recorded_anew"][method] = None if own == cell["real_successes"] else own
            found.setdefault(tuple(cell[name] for name in by), []).append(whole)
    return found


def published(load: Load, study: str, cell: str) -> Cell | None:
    """Return the results of a cell, None where they are not published."""
    try:
        return load(f"{study}/{cell}")
    except FileNotFoundError:
        return None


def outcomes(cells: Sequence[Cell], method: str, domain: str) -> list[list[int]]:
    """Return the outcomes of a method's runs on the same starts, (R, E)."""
    return [cell["methods"][method][domain]["outcomes"] for cell in cells if method in cell["methods"]]


def mean(cells: Sequence[Cell], method: str, domain: str) -> float:
    """Return a method's success, as a share, over the cells in which it has been run."""
    return float(np.mean(outcomes(cells, method, domain)))


def measured(cells: Sequence[Cell], methods: Iterable[str]) -> list[str]:
    """Return the methods that have been run in any of the cells."""
    return [method for method in methods if any(method in cell["methods"] for cell in cells)]


def having(found: Groups, method: str) -> Groups:
    """Return the cells in which a method has been run, without groups that have none."""
    kept = {group: [cell for cell in cells if method in cell["methods"]] for group, cells in found.items()}
    return {group: cells for group, cells in kept.items() if cells}


def gain(cells: Sequence[Cell], method: str, baseline: str, domain: str) -> RunsMean:
    """Return how much more often a method succeeds than a baseline on the same starts.

    Both have the same budget of real episodes, but may have other recordings (`recorded_anew`).
    """
    both = [cell for cell in cells if {method, baseline} <= cell["methods"].keys()]
    pairs = zip(outcomes(both, method, domain), outcomes(both, baseline, domain), strict=True)
    return RunsMean.over([[a - b for a, b in zip(*pair, strict=True)] for pair in pairs])


def gains(cells: Sequence[Cell], method: str, baseline: str, domain: str) -> list[float]:
    """Return the gain of each cell, which is one seed."""
    both = [cell for cell in cells if {method, baseline} <= cell["methods"].keys()]
    return [mean([cell], method, domain) - mean([cell], baseline, domain) for cell in both]


def complete(cells: Sequence[Cell], methods: Iterable[str]) -> list[str]:
    """Return the methods that have been run in all of the cells."""
    return [method for method in methods if all(method in cell["methods"] for cell in cells)]


def best(cells: Sequence[Cell], methods: Sequence[str], domain: str) -> str:
    """Return the method with the highest mean success, of those that have been run in all cells."""
    return max(complete(cells, methods), key=lambda method: mean(cells, method, domain))


def best_pair(cells: Sequence[Cell], domain: str) -> tuple[str, str]:
    """Return the best method with a world model, and the best one without."""
    return best(cells, IMAGINED, domain), best(cells, BASELINES, domain)


def against(row: dict[str, Any], before: dict[str, Any]) -> str:
    """`81 %: 25 gained, 3 lost (p = 1e-05)`."""
    change = PairedChange.between(before["outcomes"], row["outcomes"])
    return f"{100 * row['share']:.0f} %: {paired(change.as_json())}"


def minutes(cells: Sequence[Cell], method: str) -> str:
    """Return the minutes that a method's training took, the mean over its runs."""
    return f"{mean_of(cells, method, 'minutes'):.0f}"


def mean_of(cells: Sequence[Cell], method: str, number: str) -> float:
    """Return the mean of a number over the runs of a method."""
    found = [cell["methods"][method][number] for cell in cells if method in cell["methods"]]
    return float(sum(found) / len(found))


def shares(cells: Sequence[Cell], method: str, domain: str) -> str:
    """`62, 60 → 61 % (57–65)`, or `62 % (57–67)` of one seed."""
    found = outcomes(cells, method, domain)
    mean = RunsMean.over(found)
    each = ", ".join(f"{100 * sum(run) / len(run):.0f}" for run in found)
    seeds = f"{each} → " if len(found) > 1 else ""
    return f"{seeds}{100 * mean.mean:.0f} % ({100 * mean.low:.0f}–{100 * mean.high:.0f})"
