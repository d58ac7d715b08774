"""Results in a simulator that nothing here was built for: the section of docs/results.md."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from experiments.page.cells import Load, counted, points
from experiments.page.value_cells import Cell, against, published
from experiments.steps.foreign import POLICIES, TIMED
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import markdown_table as table
from lerobot_wmrl.common.statistics import RunsMean


def section(load: Load) -> str:
    """Return the section: success of the policies, seed by seed, and the mean gains."""
    variables = [each.variables for each in read_cells(ROOT / "experiments" / "metaworld.yaml")]
    cells = [cell for each in variables if (cell := published(load, "metaworld", each["cell"]))]
    rows: list[list[Any]] = []
    for cell in cells:
        found = cell["policies"]
        changes = {name: against(found[name], found["further"]) for name in ("cloned", "longer", "improve")}
        rows += [
            [cell["seed"], POLICIES[name], counted(found[name]), changes.get(name, "")] for name in POLICIES
        ]
    improved = gains(cells, "improve")
    for baseline in ("cloned", "further", "longer"):
        mean = RunsMean.over(improved - gains(cells, baseline))
        rows.append(["all", f"improved, against the one {POLICIES[baseline]}", "", points(asdict(mean))])
    first = cells[0]
    return f"""`{first["task"]}`: {first["episodes"]} episodes of a scripted expert with noise on its actions
({first["noise"]} of half their range), {first["rollouts"]} rollouts of the policy cloned from them,
{first["iterations"]} iterations of PPO. Changes are against the policy that was trained further on all
successes, on the same starts:

{table(["seed", "policy", "success", "change"], rows)}

{minutes_of(cells)} An episode of LeRobot's environment has up to 500 steps. The interval of a mean
draws seeds and starts. Everything ran by the commands that the documentation has for any data; no line of
code knows Meta-World but the [script that records it](../examples/metaworld/record.py), which uses LeRobot
alone."""


def gains(cells: Sequence[Cell], policy: str) -> np.ndarray:
    """Return the outcomes of a policy in all cells, which have the same starts. (R, E)"""
    return np.array([cell["policies"][policy]["outcomes"] for cell in cells], float)


def minutes_of(cells: Sequence[Cell]) -> str:
    """Say how long the steps of a cell took."""
    mean = {step: np.mean([cell["minutes"][step] for cell in cells]) for step in TIMED}
    return (
        f"A seed takes {mean['data']:.1f} minutes to record, {mean['cloned']:.1f} to clone, "
        f"{mean['improve']:.1f} to improve, rollouts and further training included, {mean['longer']:.1f} to "
        f"clone from scratch, and {mean['comparison']:.1f} to compare."
    )
