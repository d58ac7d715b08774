"""Collect one cell of the study of what imagination is worth: every method on the same real episodes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from experiments.run import read_record
from experiments.study import Study
from experiments.success import Results, outcomes, rate
from lerobot_wmrl.maniskill.recordings import recorded_episodes

CELL: Final = ("task", "kind", "demonstrations", "rollouts", "seed", "starts")
"""Variables of the study that say which cell it is."""


def cell(study: Study) -> Results:
    """Return the success of every method in one cell, with the minutes that its own steps took.

    `real_episodes` is what the ledger says was spent, `real_successes` counts those that were merged before
    training: rollouts of Dyna rounds are not among them.
    """
    methods: dict[str, Sequence[str]] = study.variables["methods"]
    results = {
        **{name: study.variables[name] for name in CELL},
        "real_episodes": len(json.loads(study.budget.read_text())["episodes"]),
        "real_successes": int(recorded_episodes(Path(study.variables["run"]) / "dataset")["success"].sum()),
        "methods": {name: method(study, name, steps) for name, steps in methods.items()},
    }
    return {study.variables["cell"]: results}


def controls(study: Study) -> Results:
    """Return the success of PPO in imagination under each control, in one cell."""
    found = {name: success(study, name) for name in study.variables["controls"]}
    return {study.variables["cell"]: {"controls": found}}


def method(study: Study, name: str, steps: Sequence[str]) -> dict[str, Any]:
    """Return a method's success in known and unseen scenes, and the minutes of its steps."""
    return {**success(study, name), "minutes": minutes(study, steps)}


def success(study: Study, name: str) -> dict[str, Any]:
    """Return the success in known and in unseen scenes."""
    return {domain: rate(outcomes(study.folder / f"eval_{name}_{domain}")) for domain in ("ind", "ood")}


def minutes(study: Study, steps: Sequence[str]) -> float:
    """Return the minutes that finished steps took. ValueError names one that is not finished."""
    seconds = 0.0
    for step in study.steps:
        record = read_record(study, step)
        if step.name in steps:
            if record is None:
                raise ValueError(f"{study.name}: step {step.name} is not finished")
            seconds += record["seconds"]
    return round(seconds / 60, 1)
