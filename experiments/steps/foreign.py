"""Collect results in a simulator that nothing here was built for."""

import json
from typing import Any, Final

from experiments.steps.success import Results, rate
from experiments.steps.value import seconds
from experiments.study import Study
from lerobot_wmrl.evaluation.comparison import COMPARISON_FILE

CELL: Final = ("task", "episodes", "noise", "rollouts", "iterations", "seed")

POLICIES: Final = {
    "cloned": "cloned from the expert's episodes",
    "further": "trained further on all successes, the expert's and its own",
    "longer": "cloned from scratch from all successes, for as many steps",
    "improve": "improved in imagination",
}
"""Names of the policies, in the order of the study's comparison → what they are."""

TIMED: Final = ("data", "cloned", "improve", "longer", "comparison")


def metaworld(study: Study) -> Results:
    """Return the success of the policies on the same starts, and the minutes of each step."""
    comparison: dict[str, Any] = json.loads((study.folder / "comparison" / COMPARISON_FILE).read_text())
    outcomes = zip(*(episode["successes"] for episode in comparison["episodes"]), strict=True)
    gate = study.folder / "improve" / "check" / "metrics.json"
    results = {
        **{name: study.variables[name] for name in CELL},
        "minutes": {step: round(seconds(study, step) / 60, 1) for step in TIMED},
        "policies": {name: rate(own) for name, own in zip(POLICIES, outcomes, strict=True)},
        "check": json.loads(gate.read_text()),
    }
    return {study.variables["cell"]: results}
