"""Methods that begin from one policy: what each gains on it, in tables of docs/results.md."""

from collections.abc import Mapping, Sequence

from experiments.page.cells import Load
from experiments.page.value_cells import SCENES, Cell, against, groups, measured, minutes, shares
from lerobot_wmrl.common.files import markdown_table as table


def tables(load: Load, study: str, titles: Mapping[str, str], before: str) -> str:
    """Return two tables of a study: success after every method, and what each changes, seed by seed.

    Args:
        load: reads the published results.
        study: its name.
        titles: its methods in the order of the tables, and what they are called there.
        before: the method that made the policy from which the others begin.
    """
    cells = [cell for each in groups(load, study, ()).values() for cell in each]
    rates = [
        [titles[method], *(shares(cells, method, domain) for domain in SCENES), minutes(cells, method)]
        for method in measured(cells, titles)
    ]
    return f"""{table(["method", "known scenes", "unseen scenes", "minutes"], rates)}

{changes(cells, titles, before)}"""


def changes(cells: Sequence[Cell], titles: Mapping[str, str], before: str) -> str:
    """Return a table of what methods change on one of them, seed by seed."""
    methods = measured(cells, titles)
    rows = [
        [cell["seed"], titles[method], *row]
        for cell in cells
        for method, row in changed(cell, methods, before)
    ]
    return f"""Against {titles[before]}, on the same {cells[0]["starts"]} starts:

{table(["seed", "method", "known scenes", "unseen scenes"], rows)}"""


def changed(cell: Cell, methods: list[str], before: str) -> list[tuple[str, list[str]]]:
    """Return each method of a cell, with its success and the starts gained and lost, in SCENES."""
    found = cell["methods"]
    return [
        (method, [against(found[method][domain], found[before][domain]) for domain in SCENES])
        for method in methods
        if method != before and method in found
    ]
