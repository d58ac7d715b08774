"""What a world model says about policies, beside what they do in ManiSkill."""

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest, kendalltau, pearsonr

from experiments import figures
from experiments.cells import DOMAINS, Load, counted
from experiments.study import ROOT, Study, read_cells
from experiments.success import Results
from experiments.value import policy_name
from lerobot_wmrl.common.files import markdown_table as table
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

FEW: Final = 10
"""Fewer policies than this have no correlation that says anything."""

TOLERATED: Final = 0.15
"""Difference of imagined and real success beyond which a world model is wrong about a scene."""

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


def section(load: Load) -> str:
    """Return the section of docs/results.md."""
    (study,) = read_cells(ROOT / "experiments" / "judge.yaml")
    cell = study.variables["cell"]
    found = load(f"judge/{cell}")["domains"]
    known = found["ind"]
    starts = [next(iter(each["policies"].values()))["real"]["n"] for each in found.values()]
    rows = [
        [
            DOMAINS[domain],
            title,
            f"{row['n']} ({row['trainings']})",
            *(f"{100 * row[kind]['absolute']:.0f} ({100 * row[kind]['mean']:+.0f})" for kind in ESTIMATES),
            *("–" if row["n"] < FEW else f"{row[name]:.2f}" for name in ("pearson", "kendall")),
            *(f"{row[name]['k']} of {row[name]['n']}" for name in ("by_rollouts", "by_references")),
            f"{100 * row['width']:.0f}",
        ]
        for domain, each in found.items()
        for title, row in (("no", each["outside"]), ("yes", each["inside"]))
    ]
    unexplained = [each["unexplained"] for each in found.values()]
    known_scenes, unseen_scenes = (each["scenes"].values() for each in found.values())
    outside, counts = known["outside"], [known["recall"], known["false_positive_rate"]]
    again = outside["repeated"]
    return f"""It tells good from bad policies, not similar ones apart, and thinks too well of most. In the
scenes that it has learnt from, imagined success of {outside["n"]} checkpoints that were not trained in it is
{100 * outside["imagined"]["absolute"]:.0f} points off on average; by a line through policies of other
trainings {100 * outside["calibrated"]["absolute"]:.0f}. Real success is measured on {starts[0]} known and
{starts[1]} unseen starts: measuring it again would be {100 * again["absolute"]:.0f} points off, and have a τ
of {again["kendall"]:.2f} (known scenes). {among_good(known["policies"])}

{table(HEAD, rows)}

Differences are absolute, in parentheses with their sign. *Corrected* is by 200 rollouts of one policy in
known scenes, replayed with their actions: of the successes the world model predicts {counted(counts[0])} as
successes, of the failures {counted(counts[1])}. That does not show what it does with a policy that acts on
imagined frames. *Calibrated* is by the line through the policies of all other trainings that were not trained
in the world model (two of these nine, `cloned` and `cloning`, are the same one to its 800th step, so that the
line is a little better than it should be), whose intervals of 90 % are {100 * outside["width"]:.0f} points
wide in known scenes. An interval by rollouts counts if the estimate and the measured rate may be equal.
Without references the command refuses {unexplained[0]} of these policies in known and {unexplained[1]} in
unseen scenes, which succeed in
imagination more often than the rollouts' successes, or less often than their failures. For all of them
together, imagined and real success differ by more than {100 * TOLERATED:.0f} points in
{differing(known_scenes)} known scenes and in {differing(unseen_scenes)} unseen ones.

![Imagined and real success of every policy](results/judge/{cell}.png)"""


def among_good(policies: Mapping[str, Mapping[str, Any]]) -> str:
    """Return how imagined and real success agree among policies that mostly succeed: between these and those
    that hardly do it is easy to tell."""
    rates = [
        (each["imagined"]["share"], each["real"]["share"])
        for each in policies.values()
        if not each["inside"] and each["real"]["share"] > GOOD
    ]
    imagined, real = zip(*rates, strict=True)
    return f"""Among the {len(rates)} of them that succeed in more than half of the starts, Pearson's r is
{pearsonr(imagined, real).statistic:.2f} and Kendall's τ {kendalltau(imagined, real).statistic:.2f}."""


GOOD: Final = 0.5
"""Share of real successes above which a policy counts as good."""

ESTIMATES: Final = ("imagined", "corrected", "calibrated")
HEAD: Final = (
    "scenes",
    "trained in the world model",
    "checkpoints (trainings)",
    *(f"{kind}: points off" for kind in ESTIMATES),
    "Pearson's r",
    "Kendall's τ",
    "intervals by rollouts hold",
    "intervals by references hold",
    "their width (points)",
)


def differing(scenes: Collection[Mapping[str, Any]]) -> str:
    """`2 of 16`: scenes in which imagined and real success differ too much."""
    wrong = [abs(each["imagined"]["share"] - each["real"]["share"]) > TOLERATED for each in scenes]
    return f"{sum(wrong)} of {len(wrong)}"
