"""Collect what a world model says about policies, beside what they do in ManiSkill."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest, kendalltau, pearsonr

from experiments import figures
from experiments.steps.success import Results
from experiments.steps.value import policy_name
from experiments.study import Study
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation import comparison, judgement
from lerobot_wmrl.evaluation.calibration import (
    Confusion,
    RateEstimate,
    calibrated_rate,
    corrected_rate,
)
from lerobot_wmrl.evaluation.evidence import trained_inside
from lerobot_wmrl.maniskill.scenes import SCENES as ALL_SCENES
from lerobot_wmrl.maniskill.scenes import scene_for_seed, scenes_of

SCENES: Final = {"ind": [ALL_SCENES[index] for index in (0, 1, 2)], "ood": scenes_of("ood")}
"""Scenes of known and of unseen starts: the seed chooses among them."""

COVERAGE: Final = 0.9

DRAWS: Final = 200

Row = Mapping[str, Any]
"""What is known of a policy: imagined and real success, the estimate, its training."""


def push(study: Study) -> Results:
    """Return what is estimated for every policy, in known and in unseen scenes, and how it compares."""
    inside = partial(trained_inside, world_model=study.variables["world_model"])
    found = {domain: judged(study.folder, domain, inside) for domain in SCENES}
    settings = {name: study.variables[name] for name in ("demonstrations", "rollouts", "seed")}
    figures.draw_judged(found, study.folder / f"{study.variables['cell']}.png")
    return {study.variables["cell"]: {**settings, "domains": found}}


def judged(folder: Path, domain: str, inside: Callable[[str], str | None]) -> dict[str, Any]:
    """Return every policy's estimate beside its real success, and how the two agree.

    inside: why a policy counts as trained in the world model, if it does.
    """
    said = json.loads((folder / f"judged_{domain}" / judgement.JUDGEMENT_FILE).read_text())
    real = json.loads((folder / f"real_{domain}" / comparison.COMPARISON_FILE).read_text())
    confusion = Confusion(
        Proportion.from_json(said["recall"]), Proportion.from_json(said["false_positive_rate"])
    )
    rows = {}
    for name, policy in said["policies"].items():
        corrected = corrected_rate(Proportion.from_json(policy["imagined"]), confusion, COVERAGE)
        rows[name] = {
            "imagined": policy["imagined"],
            "estimate": corrected.clipped()._asdict(),
            "real": real["policies"][name],
            "refused": policy["refused"],
            "inside": inside(name) is not None,
            "training": str(Path(name).parents[1]),
        }
    others = [name for name, row in rows.items() if not row["inside"]]
    outcomes = {
        name: [episode["successes"][index] for episode in real["episodes"]]
        for index, name in enumerate(real["policies"])
    }
    references = [rows[name] for name in others]
    return {
        "recall": said["recall"],
        "false_positive_rate": said["false_positive_rate"],
        "policies": {short_name(name): row for name, row in rows.items()},
        "outside": agreement(references, references),
        "inside": agreement([row for row in rows.values() if row["inside"]], references),
        "unexplained": sum(bool(row["refused"]) for row in references),
        "scenes": by_scene(
            domain, said["outcomes"], outcomes, [episode["seed"] for episode in real["episodes"]], others
        ),
    }


def short_name(checkpoint: str) -> str:
    """`…/act/checkpoints/000400` → `act 400`"""
    return f"{policy_name(checkpoint)} {int(Path(checkpoint).name)}"


def agreement(rows: Sequence[Row], references: Sequence[Row]) -> dict[str, Any]:
    """Return how far estimates are from real success, how well they rank, and what intervals contain.

    `by_rollouts` counts estimates whose difference to the measured rate may be 0 by the intervals of both.
    `by_references` counts measured rates within the interval that references of other trainings give.
    """
    imagined = [row["imagined"]["share"] for row in rows]
    real = [row["real"]["share"] for row in rows]
    corrected = [row["estimate"]["value"] for row in rows]
    calibrated = [by_other_trainings(row, references) for row in rows]
    within = [each.low <= share <= each.high for each, share in zip(calibrated, real, strict=True)]
    return {
        "n": len(rows),
        "trainings": len({row["training"] for row in rows}),
        "imagined": errors(imagined, real),
        "corrected": errors(corrected, real),
        "calibrated": errors([each.value for each in calibrated], real),
        "pearson": float(pearsonr(imagined, real).statistic),
        "kendall": float(kendalltau(imagined, real).statistic),
        "repeated": repeated(rows),
        "by_rollouts": Proportion(sum(map(compatible, rows)), len(rows)).as_json(),
        "by_references": Proportion(sum(within), len(rows)).as_json(),
        "width": float(np.median([each.high - each.low for each in calibrated])),
    }


def repeated(rows: Sequence[Row]) -> dict[str, float]:
    """Return how a second measurement of the same real rates would agree with them, on as many starts."""
    real, n = np.array([[row["real"]["share"], row["real"]["n"]] for row in rows]).T
    again = np.random.default_rng(0).binomial(n.astype(int), real, (DRAWS, len(rows))) / n
    return {
        "absolute": float(np.abs(again - real).mean()),
        "kendall": float(np.nanmean([kendalltau(each, real).statistic for each in again])),
    }


def by_other_trainings(row: Row, references: Sequence[Row]) -> RateEstimate:
    """Return a policy's success by the references of other trainings than its own."""
    known = [
        (each["imagined"]["share"], each["real"]["share"])
        for each in references
        if each["training"] != row["training"]
    ]
    found = calibrated_rate(row["imagined"]["share"], known, COVERAGE)
    assert found is not None, "there are enough references"
    return found.clipped()


def errors(estimates: Sequence[float], real: Sequence[float]) -> dict[str, float]:
    """Return the mean absolute and the mean error."""
    differences = np.subtract(estimates, real)
    return {"absolute": float(np.abs(differences).mean()), "mean": float(differences.mean())}


def compatible(row: Row) -> bool:
    """Return whether estimate and measured rate may be equal, by the interval of their difference.

    It is made of the intervals of both (Zou and Donner 2008); the measured rate's is Wilson's.
    """
    estimate, real = row["estimate"], row["real"]
    interval = binomtest(real["k"], real["n"]).proportion_ci(COVERAGE, "wilson")
    above = math.hypot(estimate["value"] - estimate["low"], interval.high - real["share"])
    below = math.hypot(estimate["high"] - estimate["value"], real["share"] - interval.low)
    return -below <= estimate["value"] - real["share"] <= above


def by_scene(
    domain: str,
    imagined: Mapping[str, Sequence[bool]],
    real: Mapping[str, Sequence[bool]],
    seeds: Sequence[int],
    policies: Sequence[str],
) -> dict[str, Any]:
    """Return imagined and real success of all `policies` together, by scene."""
    scenes = SCENES[domain]

    def rates(outcomes: Mapping[str, Sequence[bool]], seeds: Sequence[int]) -> dict[int, Proportion]:
        successes = np.array([outcomes[name] for name in policies])
        scene = np.array([scene_for_seed(scenes, seed).index for seed in seeds])
        parts = {each.index: successes[:, scene == each.index] for each in scenes}
        return {index: Proportion(int(part.sum()), part.size) for index, part in parts.items()}

    starts = len(next(iter(imagined.values())))
    seen, happened = rates(imagined, range(starts)), rates(real, seeds)
    return {
        str(each.index): {
            "object": each.object,
            "container": each.container,
            "table": each.table,
            "imagined": seen[each.index].as_json(),
            "real": happened[each.index].as_json(),
        }
        for each in scenes
    }
