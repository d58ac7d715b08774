"""Collect how far world models can be trusted: what lerobot-wmrl-eval-world-model left in a study's folder.

Every function takes a finished study and returns JSON content by the stem of its file.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments import figures
from experiments.steps import value
from experiments.study import Study
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.world_models.checkpoint import load_model

Results = dict[str, dict[str, Any]]

GATE: Final = ("done_threshold", "done_frames", "false_positive_rate", "recall", "auc", "passed")
KEPT: Final = (*GATE, "headline", "operating_point", "gate_by_task", "extreme_actions", "tokenizer")
"""Parts of metrics.json that are kept; curves and sweeps are large and can be made again."""

HEADLINE: Final = ("delta_psnr_0_6s", "moving_psnr", "abs_rel", "done_f1")
PSNR_STEPS: Final = (1, 10, 30)


def metrics(study: Study, name: str) -> dict[str, Any]:
    """Return `metrics.json` of one evaluation."""
    return json.loads((study.folder / name / "metrics.json").read_text())


def kept(study: Study, name: str) -> dict[str, Any]:
    """Return what results keep of one evaluation."""
    found = metrics(study, name)
    return {key: found[key] for key in KEPT if key in found}


def gate(study: Study) -> Results:
    """The gate in known and in unseen scenes."""
    both = {"known": kept(study, "check"), "unseen": kept(study, "check_ood")}
    return {"world_model_gate_anchored": {"steps": study.variables["steps"], **both}}


def one_scene(study: Study) -> Results:
    """The same in one scene."""
    return {"world_model_gate_one_scene": gate(study)["world_model_gate_anchored"]}


def autoregressive(study: Study) -> Results:
    """The same with autoregressive dynamics."""
    return {"world_model_gate": gate(study)["world_model_gate_anchored"]}


def four_tasks(study: Study) -> Results:
    """The held-out episodes of four tasks."""
    return {"world_model_four_tasks": kept(study, "check")}


def instructions(study: Study) -> Results:
    """How success is told in each task, by classifiers that read the instruction and that do not."""
    rates = {
        reads: {
            domain: json.loads((study.folder / f"told_{reads}_{domain}.json").read_text())
            for domain in ("ind", "ood")
        }
        for reads in study.variables["readers"]
    }
    settings = {name: study.variables[name] for name in ("demonstrations", "rollouts", "seed", "judged")}
    return {study.variables["cell"]: {**settings, "reads": rates}}


def codes(study: Study) -> Results:
    """Quantizers under a world model, PPO in each, and success decided by the goal frame."""
    settings = {name: study.variables[name] for name in ("demonstrations", "rollouts", "seed", "starts")}
    methods: dict[str, Any] = study.variables["methods"]
    found = {
        **settings,
        "judged": study.variables["judged"],
        "real_successes": value.successes(study.folder / "dataset"),
        "methods": {name: value.method(study, name, steps) for name, steps in methods.items()},
        "gates": {
            kind: {domain: kept(study, f"gate_{kind}_{domain}") for domain in study.variables["domains"]}
            for kind in study.variables["kinds"]
        },
        "goal_distance": json.loads((study.folder / "goal_distance.json").read_text()),
    }
    return {study.variables["cell"]: found}


def variants(study: Study) -> Results:
    """RoboScape's options."""
    return {"world_model_ablation": _trainings(study)}


def network_variants(study: Study) -> Results:
    """Conditioning, decoding and feedback."""
    return {"world_model_ablation_network": _trainings(study)}


def learning_curve(study: Study) -> Results:
    """Data, time and size."""
    results = _trainings(study)
    figures.draw_learning_curve(results["variants"], study.folder / "learning_curve.png")
    return {"learning_curve": results}


def _trainings(study: Study) -> dict[str, Any]:
    """Return a row for every `<variant>_<seed>` that was replayed as `replay_…` and judged as `gate_…`."""
    names = [step.name.removeprefix("replay_") for step in study.steps if step.name.startswith("replay_")]
    return {"variants": {name: _training(study, name) for name in names}}


def _training(study: Study, name: str) -> dict[str, Any]:
    """Return one training's size and time, its accuracy on held-out episodes, and the gate of rollouts."""
    replay, judged = metrics(study, f"replay_{name}"), metrics(study, f"gate_{name}")
    folder = study.folder / name
    config = json.loads((folder / "train_config.json").read_text())
    model = load_model(folder, "action_world_model", "cpu")
    chosen = config["dataset"]["episodes"]
    dataset = Path(config["dataset"]["root"]) / "meta" / "info.json"
    return {
        **training_minutes(folder),
        "episodes": len(chosen) if chosen else json.loads(dataset.read_text())["total_episodes"],
        "parameters": sum(weight.numel() for weight in model.parameters() if weight.requires_grad),
        **{f"psnr_{step}": _at_step(replay, "psnr", step) for step in PSNR_STEPS},
        **{key: replay["headline"][key] for key in HEADLINE if key in replay["headline"]},
        "gate": {key: judged[key] for key in GATE},
    }


def training_minutes(folder: Path) -> dict[str, Any]:
    """Return the steps of a training and the minutes that they took."""
    last = read_metrics(folder)[-1]
    return {"steps": last["step"], "minutes": round(last["step"] / last["steps_per_s"] / 60, 2)}


def _at_step(found: Mapping[str, Any], name: str, step: int) -> dict[str, Any]:
    """Return a curve's value at a step with its band; None where no episode lasts so long."""
    curve, band = found[f"{name}_by_step"], found["bands"][name]
    if len(curve) < step or not np.isfinite(curve[step - 1] or np.nan):
        return {"value": None, "bootstrap_95": None, "episodes": 0}
    low, high = (side[step - 1] for side in band)
    return {
        "value": curve[step - 1],
        "bootstrap_95": [low, high],
        "episodes": found["episodes_by_step"][step - 1],
    }
