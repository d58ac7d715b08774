"""Read a study: a YAML file with a question, the commands that answer it, and what they write into docs/.

A file has these keys:

    question   what the study answers
    needs      studies whose folders its commands read; `$gate` is the folder of gate.yaml. Of a study with
               cells it is the folder of the cell that has this cell's values
    extends    another study, whose keys hold where this one has none of its own (an empty `budget:` is none),
               and whose steps may be named in place of being written again
    budget     real episodes that all its methods may learn from: demonstrations, rollouts, play. `$budget` is
               the ledger, $output_dir/budget.json, which commands are given as --budget=$budget
    variables  names for commands; a later one may use an earlier one
    cells      variables with a list of values each, which hold in place of those in `variables`: the study
               is run once for every combination, in a folder `$cell` of its own, and publishes each one's
               results as soon as it is finished. In place of a list, a mapping from each value to more
               variables, which hold in its cells
    steps      name, command; `for`: repeat the step for every combination; `fresh: true`: delete first what
               an interrupted run of it has left, since the command refuses that
    collect    a function of experiments.steps, `module.function(study)`, that returns results by their stem
    results    what appears in docs/, made by a step or by `collect` in the study's folder; with `$cell` in
               the name where the study has cells

`$name` in a command is a variable, `$$` a dollar sign, and bash runs the command.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from string import Template
from typing import Any, Final

import yaml

BUDGET: Final = "budget"
"""Key of the limits, and variable with the ledger."""

ROOT: Final = Path(__file__).parents[1]
OUTPUTS: Final = Path("outputs/experiments")
KEYS: Final = {
    "question",
    "needs",
    "extends",
    "budget",
    "variables",
    "cells",
    "steps",
    "collect",
    "results",
}


@dataclass(frozen=True)
class Step:
    """One command of a study, ready to be typed."""

    name: str
    command: str
    fresh: bool = False
    """Whether the folder that it writes is deleted before it runs."""

    @property
    def output(self) -> Path | None:
        """The folder that the command writes, by its flags."""
        found = re.search(r"--(?:output_dir|new_root|target|export)=(\S+)", self.command)
        return Path(found[1]) if found else None


@dataclass(frozen=True)
class Study:
    """A study, or one cell of it, with all variables filled in."""

    name: str
    question: str
    needs: Mapping[str, Path]
    """Studies that must have been run: name → folder, that of a cell where the study has cells."""
    variables: Mapping[str, Any]
    steps: tuple[Step, ...]
    collect: str | None
    results: tuple[str, ...]
    """Paths below docs/, such as `results/rl_comparison.json`."""
    limits: Mapping[str, int] | None = None
    """Real episodes by what they are spent on; None without a budget."""

    @property
    def folder(self) -> Path:
        """Where everything that the study makes lies."""
        return Path(self.variables["output_dir"])

    @property
    def budget(self) -> Path:
        """The ledger of a study with a budget."""
        return Path(self.variables[BUDGET])


def read_cells(path: Path, given: Sequence[str] = ()) -> list[Study]:
    """Read a study, once for each of its cells.

    Args:
        path: the YAML file.
        given: `name=value` for variables, `output_dir` and needed studies included. A value or a list of
            values for a variable that makes cells restricts them.

    Raises:
        ValueError: a key, variable or value is not known.
    """
    content = read_keys(path)
    cells = {name: list(values) for name, values in cells_of(path).items()}
    rest = []
    for assignment in given:
        name, _, value = assignment.partition("=")
        if name in cells:
            read = yaml.safe_load(value)
            chosen = read if isinstance(read, list) else [read]
            if wrong := [each for each in chosen if each not in cells[name]]:
                there = ", ".join(map(str, cells[name]))
                raise ValueError(f"{path}: {name}={wrong[0]}: there are {there}")
            cells[name] = chosen
        else:
            rest.append(assignment)
    combinations = (dict(zip(cells, values, strict=True)) for values in product(*cells.values()))
    return [_read_cell(path, content, cell, rest) for cell in combinations]


def cells_of(path: Path) -> Mapping[str, Any]:
    """Return the variables that make a study's cells, with their values (and what each value brings)."""
    return read_keys(path).get("cells", {})


def cell_name(cell: Mapping[str, Any]) -> str:
    """Return the folder of a cell: `demonstrations8_seed0_labels`, the values of words by themselves."""
    return "_".join(value if isinstance(value, str) else f"{key}{value}" for key, value in cell.items())


def _read_cell(
    path: Path, content: Mapping[str, Any], cell: Mapping[str, Any], given: Sequence[str]
) -> Study:
    """Return a study with the variables of one cell, in that cell's folder."""
    needs, name = content.get("needs", ()), cell_name(cell)
    more = {}
    for key, value in cell.items():
        if isinstance(values := content["cells"][key], Mapping):
            more.update(values[value])
    folders = {"output_dir": str(OUTPUTS / path.stem), **{need: str(OUTPUTS / need) for need in needs}}
    if content.get(BUDGET):
        folders[BUDGET] = "$output_dir/budget.json"
    own = {"cell": name, **cell} if cell else {}
    cells = {"output_dir": name, **{need: _cell_needed(path, need, cell) for need in needs}}
    # `own` comes first, for variables that use it, and again after those that it replaces
    declared = {**own, **folders, **content.get("variables", {}), **own, **more}
    variables = resolve(declared, given, cells)
    steps = tuple(step for entry in content["steps"] for step in repeated(entry, variables))
    names = [step.name for step in steps]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(
            f"{path}: steps with the same name: {', '.join(sorted(twice))}; add a variable to it"
        )
    return Study(
        path.stem,
        " ".join(content["question"].split()),
        {need: Path(variables[need]) for need in needs},
        variables,
        steps,
        content.get("collect"),
        tuple(fill(result, variables) for result in content.get("results", ())),
        read_limits(content[BUDGET], variables) if content.get(BUDGET) else None,
    )


def _cell_needed(path: Path, need: str, cell: Mapping[str, Any]) -> str:
    """Return the cell of a needed study that has the values of `cell`; nothing if it has no cells.

    Raises:
        ValueError: a variable that makes its cells makes none of this study's.
    """
    needed = cells_of(path.parent / f"{need}.yaml")
    if missing := needed.keys() - cell.keys():
        names = ", ".join(sorted(missing))
        raise ValueError(f"{path}: `cells` lacks {names}, which makes the cells of {need}, which it needs")
    return cell_name({key: cell[key] for key in needed})


def read_limits(budget: Mapping[str, Any], variables: Mapping[str, Any]) -> dict[str, int]:
    """Return the limits of a budget, with variables filled in. ValueError names one that is no number."""
    filled = {name: yaml.safe_load(fill(as_text(limit), variables)) for name, limit in budget.items()}
    for name, limit in filled.items():
        if not isinstance(limit, int):
            raise ValueError(f"budget: {name} must be a number of episodes, not {limit}")
    return filled


def read_keys(path: Path) -> dict[str, Any]:
    """Return the keys of a study file, those of the study that it extends below its own.

    Raises:
        ValueError: a key is unknown, or a step that is only named is not one of the extended study.
    """
    content: dict[str, Any] = yaml.load(path.read_text(), yaml.CSafeLoader)  # ten times as fast
    if unknown := content.keys() - KEYS:
        raise ValueError(
            f"{path}: unknown key {', '.join(sorted(unknown))}; there are {', '.join(sorted(KEYS))}"
        )
    base = read_keys(path.parent / content["extends"]) if "extends" in content else {}
    written = {entry["name"]: entry for entry in base.get("steps", ())}
    steps = content.get("steps", tuple(written))
    if missing := [entry for entry in steps if isinstance(entry, str) and entry not in written]:
        raise ValueError(
            f"{path}: step {', '.join(missing)}: write its name and command; only a step of a study that "
            f"this one extends may be named alone ({', '.join(written) or 'it extends none'})"
        )
    variables = {**base.get("variables", {}), **content.get("variables", {})}
    steps = [written[entry] if isinstance(entry, str) else entry for entry in steps]
    return {**base, "results": (), "collect": None, **content, "variables": variables, "steps": steps}


def resolve(variables: Mapping[str, Any], given: Sequence[str], cells: Mapping[str, str]) -> dict[str, Any]:
    """Return the variables, with those `given` as `name=value` in their place and all `$name` filled in.

    Those that name a study's folder are in `cells`: they go on to the cell there, or to nothing.
    """
    chosen = dict(variables)
    for assignment in given:
        name, equals, value = assignment.partition("=")
        if not equals or name not in chosen:
            raise ValueError(f"{assignment}: give name=value, with one of {', '.join(chosen)}")
        chosen[name] = yaml.safe_load(value)
    for name, cell in cells.items():
        chosen[name] = str(Path(chosen[name]) / cell)
    filled: dict[str, Any] = {}
    for name, value in chosen.items():
        filled[name] = fill(value, filled) if isinstance(value, str) else value
    return filled


def repeated(entry: Mapping[str, Any], variables: Mapping[str, Any]) -> list[Step]:
    """Return the steps of one entry.

    `for` is a list of rows, or a mapping from names to lists (or to the name of a variable that is one), of
    which every combination is taken.
    """
    rows = entry.get("for", [{}])
    if isinstance(rows, Mapping):
        lists = [variables[values] if isinstance(values, str) else values for values in rows.values()]
        rows = [dict(zip(rows, values, strict=True)) for values in product(*lists)]
    steps = []
    for row in rows:
        known = {**variables, **row}
        known.update({name: fill(value, known) for name, value in row.items() if isinstance(value, str)})
        command = " ".join(fill(entry["command"], known).split())
        step = Step(fill(entry["name"], known), command, entry.get("fresh", False))
        if step.fresh and step.output is None:
            raise ValueError(f"step {step.name}: `fresh` needs a flag that says where its command writes")
        steps.append(step)
    return steps


def fill(text: str, variables: Mapping[str, Any]) -> str:
    """Replace every `$name`. ValueError names one that is not known."""
    template = Template(text)
    try:
        return template.substitute({name: as_text(variables[name]) for name in template.get_identifiers()})
    except KeyError as error:
        raise ValueError(f"${error.args[0]} in {text!r}: there is no such variable") from None


def as_text(value: Any) -> str:
    """Return a value as a flag has it: `[0,1]`, `true`, `0.5`."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
