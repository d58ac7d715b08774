"""What imagination is worth with more demonstrations or fewer rollouts, on the same recordings: section of
docs/results.md."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from experiments.page.cells import Load
from experiments.page.from_one_policy import changes
from experiments.page.value_cells import (
    BASELINES,
    IMAGINED,
    SCENES,
    TITLES,
    Cell,
    complete,
    groups,
    mean,
    measured,
    minutes,
    shares,
)
from lerobot_wmrl.common.files import markdown_table as table

STUDY: Final = "value_same_recordings"

LIMITS: Final = """\
All methods of a seed have the same demonstrations and rollouts, and are compared on the same starts. The
baseline is the one that succeeds most often on the reported starts, known and unseen together, which favours
it; PPO in ManiSkill was not run here. Settings are those of [value_push](#value_push), where they were chosen
with 8 demonstrations and 300 rollouts.
`minutes` are upper bounds, beside other work."""


def section(load: Load) -> str:
    """Return the section: for each number of real episodes success, and changes on the best baseline."""
    return "\n\n".join([*(part(cells) for cells in groups(load, STUDY, ()).values()), LIMITS])


def part(cells: Sequence[Cell]) -> str:
    """Return two tables of the cells of a number of real episodes."""
    methods = measured(cells, TITLES)
    rival = best_baseline(cells)
    rows = [
        [TITLES[method], *(shares(cells, method, domain) for domain in SCENES), minutes(cells, method)]
        for method in methods
    ]
    compared = {method: TITLES[method] for method in methods if method in IMAGINED or method == rival}
    first = cells[0]
    return f"""**{first["demonstrations"]} demonstrations and {first["rollouts"]} rollouts**, of which
{", ".join(str(cell["real_successes"]) for cell in cells)} succeed; PPO begins with
{" and ".join(sorted({TITLES[cell["start"]] for cell in cells}))}:

{table(["method", "known scenes", "unseen scenes", "minutes"], rows)}

{changes(cells, compared, rival)}"""


def best_baseline(cells: Sequence[Cell]) -> str:
    """Return the method without a world model that succeeds most often, known and unseen scenes together."""

    def success(method: str) -> float:
        return float(np.mean([mean(cells, method, domain) for domain in SCENES]))

    return max(complete(cells, BASELINES), key=success)
