"""What a world model says about policies, beside what they do in ManiSkill."""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import kendalltau, pearsonr

from experiments import figures
from experiments.cells import DOMAINS, Load, counted, table
from experiments.study import ROOT, Study, read_cells
from experiments.success import Results
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation import comparison, judgement
from lerobot_wmrl.evaluation.calibration import Recognition, conformal_margin, corrected_rate
from lerobot_wmrl.maniskill.scenes import SCENES as ALL_SCENES
from lerobot_wmrl.maniskill.scenes import scene_for_seed, scenes_of

SCENES: Final = {"ind": [ALL_SCENES[index] for index in (0, 1, 2)], "ood": scenes_of("ood")}
"""Scenes of known and of unseen starts: the seed chooses among them."""

COVERAGE: Final = 0.9


def push(study: Study) -> Results:
    """Return what is estimated for every policy, in known and in unseen scenes, and how it compares."""
    found = {domain: judged(study.folder, domain) for domain in SCENES}
    settings = {name: study.variables[name] for name in ("demonstrations", "rollouts", "seed")}
    figures.draw_judged(found, study.folder / f"{study.variables['cell']}.png")
    return {study.variables["cell"]: {**settings, "domains": found}}


def judged(folder: Path, domain: str) -> dict[str, Any]:
    """Return every policy's estimate beside its real success, and how often intervals contain that."""
    said = json.loads((folder / f"judged_{domain}" / judgement.RESULTS).read_text())
    real = json.loads((folder / f"real_{domain}" / comparison.RESULTS).read_text())
    outcomes = {
        name: [episode["successes"][index] for episode in real["episodes"]]
        for index, name in enumerate(real["policies"])
    }
    seeds = [episode["seed"] for episode in real["episodes"]]
    recognition = Recognition(
        *(as_rate(said["rollouts"][name]) for name in ("recall", "false_positive_rate"))
    )
    rows = {
        name: {
            "imagined": policy["imagined"],
            "estimate": corrected_rate(as_rate(policy["imagined"]), recognition, COVERAGE)._asdict(),
            "real": real["policies"][name],
            "inside": policy["refused"] is not None,
        }
        for name, policy in said["policies"].items()
    }
    others = [name for name, row in rows.items() if not row["inside"]]
    return {
        "rollouts": said["rollouts"],
        "policies": {short_name(name): row for name, row in rows.items()},
        "outside": agreement([rows[name] for name in others], [rows[name] for name in others]),
        "inside": agreement([row for row in rows.values() if row["inside"]], [rows[name] for name in others]),
        "scenes": by_scene(domain, said["outcomes"], outcomes, seeds, others),
    }


def as_rate(found: Mapping[str, Any]) -> Proportion:
    return Proportion(found["k"], found["n"])


def short_name(checkpoint: str) -> str:
    """`…/act/checkpoints/000400` → `act 400`"""
    path = Path(checkpoint)
    return f"{path.parents[1].name} {int(path.name)}"


def error(row: Mapping[str, Any]) -> float:
    return float(row["estimate"]["value"] - row["real"]["share"])


def agreement(rows: Sequence[Mapping[str, Any]], references: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return how far estimates are from real success, how well they rank, and what intervals contain.

    `corrected` are the intervals that rest on labelled rollouts alone. `conformal` are those by references:
    every policy's by all others.
    """
    estimates = [row["estimate"]["value"] for row in rows]
    real = [row["real"]["share"] for row in rows]
    inside = [row["estimate"]["low"] <= row["real"]["share"] <= row["estimate"]["high"] for row in rows]
    margins = [
        conformal_margin([error(other) for other in references if other is not row], COVERAGE) for row in rows
    ]
    covered = [abs(error(row)) <= margin for row, margin in zip(rows, margins, strict=True)]
    return {
        "n": len(rows),
        "mean_error": float(np.mean([error(row) for row in rows])),
        "mean_absolute_error": float(np.mean([abs(error(row)) for row in rows])),
        "uncorrected": float(np.mean([abs(row["imagined"]["share"] - row["real"]["share"]) for row in rows])),
        "pearson": float(pearsonr(estimates, real).statistic),
        "kendall": float(kendalltau(estimates, real).statistic),
        "corrected": Proportion(sum(inside), len(rows)).as_json(),
        "conformal": Proportion(sum(covered), len(rows)).as_json(),
        "margin": float(np.median(margins)),
    }


def by_scene(
    domain: str, imagined: Mapping[str, Sequence[bool]], real: Mapping[str, Sequence[bool]],
    seeds: Sequence[int], policies: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """Return imagined and real success of all `policies` together, by scene."""
    scenes = SCENES[domain]

    def rates(outcomes: Mapping[str, Sequence[bool]], seeds: Sequence[int]) -> dict[int, Proportion]:
        table = np.array([outcomes[name] for name in policies])
        scene = np.array([scene_for_seed(scenes, seed).index for seed in seeds])
        return {
            each.index: Proportion(
                int(table[:, scene == each.index].sum()), table[:, scene == each.index].size
            )
            for each in scenes
        }

    starts = len(next(iter(imagined.values())))
    seen, happened = rates(imagined, range(starts)), rates(real, seeds)
    return {
        str(each.index): {
            "object": each.object, "container": each.container, "table": each.table,
            "imagined": seen[each.index].as_json(), "real": happened[each.index].as_json(),
        }
        for each in scenes
    }  # fmt: skip


def section(load: Load) -> str:
    """Return the section of docs/results.md."""
    (study,) = read_cells(ROOT / "experiments" / "judge.yaml")
    cell = study.variables["cell"]
    found = load(f"judge/{cell}")["domains"]
    known = found["ind"]
    outside, (recall, false_positives) = known["outside"], known["rollouts"].values()
    starts = next(iter(known["policies"].values()))["real"]["n"]
    rows = [
        [
            DOMAINS[domain], title, row["n"], *(f"{100 * row[name]:.0f}" for name in ERRORS),
            *(f"{row[name]:.2f}" for name in RANKS),
            *(f"{row[name]['k']} of {row[name]['n']}" for name in INTERVALS),
        ]
        for domain, each in found.items()
        for title, row in (("no", each["outside"]), ("yes", each["inside"]))
    ]  # fmt: skip
    known_scenes, unseen_scenes = (each["scenes"].values() for each in found.values())
    return f"""In the scenes that it has learnt from, its estimates for {outside["n"]} checkpoints that
were not trained in it are {100 * outside["mean_absolute_error"]:.0f} points off on average; each is measured
on {starts} starts.

{table(HEAD, rows)}

On the labelled rollouts of one policy the world model recognises {counted(recall)} of the successes and takes
{counted(false_positives)} of the failures for successes, by which success in imagination is corrected.
Intervals shall contain 90 % of the rates. They are made by these two numbers, or by the errors about all
other policies that were not trained in the world model. For all of those together, imagined and real success
differ by more than {100 * TOLERATED:.0f} points in {differing(known_scenes)} known scenes and in
{differing(unseen_scenes)} unseen ones.

![Estimated and real success of every policy](results/judge/{cell}.png)"""


def differing(scenes: Collection[Mapping[str, Any]]) -> str:
    """`2 of 16`: scenes in which imagined and real success differ too much."""
    wrong = [abs(each["imagined"]["share"] - each["real"]["share"]) > TOLERATED for each in scenes]
    return f"{sum(wrong)} of {len(wrong)}"


ERRORS: Final = ("uncorrected", "mean_absolute_error")
RANKS: Final = ("pearson", "kendall")
INTERVALS: Final = ("corrected", "conformal")
HEAD: Final = (
    "scenes", "trained in the world model", "policies", "imagined: points off", "corrected: points off",
    "Pearson's r", "Kendall's τ", "intervals by rollouts contain", "intervals by references contain",
)  # fmt: skip

TOLERATED: Final = 0.15
"""Difference of imagined and real success beyond which a world model is wrong about a scene."""
