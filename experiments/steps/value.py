"""Collect one cell of the study of what imagination is worth: every method on the same real episodes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from experiments.run import read_record
from experiments.steps.choose_policy import chosen_policy
from experiments.steps.success import Results, outcomes, rate
from experiments.study import Study
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import Ledger
from lerobot_wmrl.evaluation.comparison import COMPARISON_FILE

CELL: Final = ("task", "kind", "demonstrations", "rollouts", "seed", "starts")
"""Variables of the study that say which cell it is."""


def cell(study: Study) -> Results:
    """Return the success of every method in one cell, with the minutes that the steps it needs took."""
    methods: dict[str, Sequence[str]] = study.variables["methods"]
    results = {
        **{name: study.variables[name] for name in CELL},
        **spent(study),
        "methods": {name: method(study, name, steps) for name, steps in methods.items()},
    }
    return {study.variables["cell"]: results}


def time_limit(study: Study) -> Results:
    """Return the success of policies of another study within another number of steps."""
    settings = {name: study.variables[name] for name in ("demonstrations", "rollouts", "seed", "starts")}
    methods = {
        name: {domain: rate(outcomes(study.folder / f"eval_{name}_{domain}")) for domain in ("ind", "ood")}
        for name in study.variables["policies"]
    }
    steps = study.variables["episode_length"]
    return {study.variables["cell"]: {**settings, "episode_length": steps, "methods": methods}}


def four_tasks(study: Study) -> Results:
    """Return the success of one policy in each of its tasks, after every method, on the same starts.

    `minutes` are those of the steps on the machines that the provenance names.
    """
    methods: dict[str, Sequence[str]] = study.variables["methods"]
    rates = {
        task: {
            domain: {name: rate(outcomes(study.folder / f"eval_{name}_{task}_{domain}")) for name in methods}
            for domain in ("ind", "ood")
        }
        for task in study.variables["tasks"]
    }
    results = {
        **{name: study.variables[name] for name in ("demonstrations", "rollouts", "seed", "starts")},
        **spent(study),
        "minutes": {name: minutes(study, steps) for name, steps in methods.items()},
        "tasks": rates,
    }
    if (gate := study.folder / "check" / "metrics.json").exists():
        results["gate"] = json.loads(gate.read_text())["gate_by_task"]
    return {study.variables["cell"]: results}


def spent(study: Study) -> dict[str, Any]:
    """Return the real episodes of a cell, and where PPO in imagination began.

    `real_episodes` is what the ledger says was spent, `real_successes` counts those that were merged before
    training: rollouts of Dyna rounds are not among them, and PPO in ManiSkill has none. `start` is the
    policy that PPO in imagination begins from, `imagined` the share of starts from which the policies it is
    chosen from succeed in imagination.
    """
    run = Path(study.variables["run"])
    dataset = run / "dataset"
    return {
        "real_episodes": Ledger(study.budget).read().spent().total(),
        "real_successes": successes(dataset) if dataset.exists() else None,
        **begun(run),
    }


def successes(root: Path) -> int:
    """Count the successful episodes of a dataset."""
    return int(read_episodes(open_dataset(root)).success.sum())


def begun(run: Path) -> dict[str, Any]:
    """Return which policy imagination has chosen to begin from, and how often each succeeded in it."""
    results = run / "comparison" / COMPARISON_FILE
    if not results.exists():
        return {"start": None}
    comparison = json.loads(results.read_text())
    shares = {policy_name(path): rate["share"] for path, rate in comparison["policies"].items()}
    return {"start": policy_name(chosen_policy(comparison)), "imagined": shares}


def policy_name(checkpoint: str) -> str:
    """Return the folder of the training that made a checkpoint: `…/filtered/checkpoints/003000`."""
    return Path(checkpoint).parents[1].name


def control(study: Study) -> Results:
    """Return the success of methods in a world model that learnt from changed data."""
    rates = {name: success(study, name) for name in study.variables["methods"]}
    settings = {
        name: study.variables[name] for name in ("control", "demonstrations", "rollouts", "seed", "starts")
    }
    return {study.variables["cell"]: {**settings, "methods": rates}}


def driven(study: Study) -> Results:
    """Return the success of the policies cloned from driven and from planned demonstrations."""
    settings = {
        name: study.variables[name] for name in ("count", "demonstrations", "rollouts", "seed", "starts")
    }
    driven = json.loads((study.folder / "person" / "script.json").read_text())["actions"]
    wanted = [len(actions) for actions in driven]
    if (kept := read_episodes(open_dataset(study.folder / "driven")).length.tolist()) != wanted:
        raise ValueError(f"lerobot-record has kept {kept} frames of {wanted}: it did not keep up; repeat it")
    rates = {name: success(study, name) for name in study.variables["methods"]}
    return {study.variables["cell"]: {**settings, "methods": rates}}


def method(study: Study, name: str, steps: Sequence[str]) -> dict[str, Any]:
    """Return a method's success, the minutes of its steps, and the seconds that it takes for an episode."""
    training = minutes(study, steps)
    rates = success(study, name)
    evaluated = sum(seconds(study, f"eval_{name}_{domain}") for domain in rates)
    episodes = sum(each["n"] for each in rates.values())
    return {
        **rates,
        "minutes": training,
        "seconds_an_episode": round(evaluated / episodes, 2),
    }


def minutes(study: Study, steps: Sequence[str]) -> float:
    """Return the minutes that these steps took."""
    return round(sum(seconds(study, step) for step in steps) / 60, 1)


def success(study: Study, name: str) -> dict[str, Any]:
    """Return the success in known and in unseen scenes."""
    return {domain: rate(outcomes(study.folder / f"eval_{name}_{domain}")) for domain in ("ind", "ood")}


def seconds(study: Study, step: str) -> float:
    """Return the seconds of a finished step, of the study, of the run that it continues or of what it needs.

    Raises:
        ValueError: it is not finished.
    """
    run = [Path(study.variables["run"])] if "run" in study.variables else []
    for folder in (study.folder, *run, *study.needs.values()):
        if record := read_record(folder, step):
            return float(record["seconds"])
    raise ValueError(f"{study.name}: step {step} is not finished")
