"""What is collected of a judgement: errors, ranks, what intervals contain, and success by scene."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments.steps.judged import SCENES, agreement, by_scene, compatible, judged
from lerobot_wmrl.common.statistics import Proportion

PERFECT = {
    "recall": Proportion(1000, 1000).as_json(),
    "false_positive_rate": Proportion(0, 1000).as_json(),
}


def row(estimate: float, k: int, n: int = 100, training: str = "a", half: float = 0.05) -> dict[str, Any]:
    interval = {"value": estimate, "low": estimate - half, "high": estimate + half}
    return {
        "imagined": {"share": estimate},
        "estimate": interval,
        "real": Proportion(k, n).as_json(),
        "training": training,
    }


def test_a_policy_is_calibrated_by_other_trainings_than_its_own():
    """Of ten trainings the world model thinks 10 points too well; of the eleventh, 30 points."""
    references = [row(0.05 * place + 0.1, 5 * place, training=str(place)) for place in range(1, 11)]
    wrong = [row(0.8, 50, training="wrong"), row(0.7, 40, training="wrong")]
    found = agreement(wrong, [*references, *wrong])
    assert (found["n"], found["trainings"]) == (2, 1)
    assert found["imagined"] == pytest.approx({"absolute": 0.3, "mean": 0.3})
    assert found["calibrated"] == pytest.approx({"absolute": 0.2, "mean": 0.2})
    assert found["by_references"]["k"] == 0
    assert agreement([row(0.6, 50), row(0.65, 55)], references)["by_references"]["k"] == 2


def test_a_measured_rate_of_few_starts_is_compatible_with_more_estimates():
    assert compatible(row(0.5, 9, 20))
    assert compatible(row(0.5, 7, 20))
    assert not compatible(row(0.5, 350, 1000))
    assert not compatible(row(0.2, 350, 1000))


def test_success_is_counted_by_the_scenes_of_the_seeds():
    """Imagined starts are numbered from 0, real seeds go through the same scenes from their own first one."""
    number = len(SCENES["ood"])
    imagined = {"a": [start % number == 3 for start in range(2 * number)]}
    real = {"a": [seed % number == 5 for seed in range(7, 7 + number)]}
    found = by_scene("ood", imagined, real, range(7, 7 + number), ["a"])
    scenes = [str(scene.index) for scene in SCENES["ood"]]
    assert {name for name, each in found.items() if each["imagined"]["k"]} == {scenes[3]}
    assert found[scenes[3]]["imagined"]["n"] == 2
    assert {name for name, each in found.items() if each["real"]["k"]} == {scenes[5]}


def test_policies_that_were_trained_in_the_world_model_are_kept_apart(tmp_path: Path):
    """Imagination is right about twelve trainings; the last two were trained in it."""
    names = [f"out/act{number}/checkpoints/000100" for number in range(14)]
    outcomes = {name: [start <= 2 * number for start in range(30)] for number, name in enumerate(names)}
    rates = {name: Proportion(sum(own), 30).as_json() for name, own in outcomes.items()}
    policies = {
        name: {"imagined": rate, "refused": "no rate explains it" if name == names[0] else None}
        for name, rate in rates.items()
    }
    episodes = [{"seed": seed, "successes": [own[seed] for own in outcomes.values()]} for seed in range(30)]
    contents = {
        "judged_ind/judgement.json": {**PERFECT, "policies": policies, "outcomes": outcomes},
        "real_ind/comparison.json": {"policies": rates, "episodes": episodes},
    }
    for name, content in contents.items():
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(json.dumps(content))
    found = judged(tmp_path, "ind", {names[12]: "it was trained there", names[13]: "it was"}.get)
    assert found["outside"]["n"] == 12
    assert found["inside"]["n"] == 2
    assert found["unexplained"] == 1
    assert found["outside"]["imagined"]["absolute"] == 0
    assert found["outside"]["calibrated"]["absolute"] == pytest.approx(0, abs=1e-9)
    assert found["outside"]["kendall"] == pytest.approx(1)
    assert found["policies"]["act7 100"]["estimate"]["value"] == pytest.approx(0.5)
    assert sum(each["real"]["n"] for each in found["scenes"].values()) == 12 * 30
