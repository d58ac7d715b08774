"""What is collected of a judgement: errors, ranks, what intervals contain, and success by scene."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments.judged import SCENES, agreement, by_scene, judged
from lerobot_wmrl.common.statistics import Proportion

PERFECT = {"recall": {"k": 1000, "n": 1000}, "false_positive_rate": {"k": 0, "n": 1000}}


def row(estimate: float, real: float, half: float = 0.05) -> dict[str, Any]:
    interval = {"value": estimate, "low": estimate - half, "high": estimate + half}
    return {"imagined": {"share": estimate}, "estimate": interval, "real": {"share": real}}


def test_intervals_are_counted_and_every_policy_is_covered_by_the_errors_about_all_others():
    """Errors of 1 to 11 points in the same order as the rates: the largest is above all others'."""
    rows = [row(0.05 * place + 0.01 * place, 0.05 * place) for place in range(1, 12)]
    found = agreement(rows, rows)
    assert found["kendall"] == pytest.approx(1)
    assert found["mean_error"] == found["mean_absolute_error"] == pytest.approx(0.06)
    assert found["corrected"]["k"] == 5  # errors up to 5 points
    assert found["conformal"]["k"] == 10
    assert found["margin"] == pytest.approx(0.11)


def test_policies_of_another_kind_are_covered_by_the_errors_about_the_references():
    references = [row(0.05 * place + 0.01 * place, 0.05 * place) for place in range(1, 12)]
    found = agreement([row(0.9, 0.5), row(0.5, 0.45)], references)
    assert (found["conformal"]["k"], found["n"]) == (1, 2)


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
    folders = [
        f"out/{name}/checkpoints/000100" for name in ("cloned", "act", "diffusion", "ppo", "distilled")
    ]
    shares = [0.2, 0.5, 0.8, 0.9, 0.7]
    outcomes = {
        name: [start < 30 * share for start in range(30)] for name, share in zip(folders, shares, strict=True)
    }
    policies = {
        name: {"imagined": Proportion(sum(own), 30).as_json(), "refused": "it was" if index > 2 else None}
        for index, (name, own) in enumerate(outcomes.items())
    }
    said = {"rollouts": PERFECT, "policies": policies, "outcomes": outcomes}
    episodes = [{"seed": seed, "successes": [own[seed] for own in outcomes.values()]} for seed in range(30)]
    real = {
        "policies": {name: Proportion(sum(own), 30).as_json() for name, own in outcomes.items()},
        "episodes": episodes,
    }
    for name, content in {"judged_ind/judgement.json": said, "real_ind/comparison.json": real}.items():
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(json.dumps(content))
    found = judged(tmp_path, "ind")
    assert found["outside"]["n"] == 3
    assert found["inside"]["n"] == 2
    assert found["outside"]["mean_absolute_error"] == pytest.approx(0, abs=1e-9)
    assert found["policies"]["act 100"]["estimate"]["value"] == pytest.approx(0.5)
    assert sum(each["real"]["n"] for each in found["scenes"].values()) == 3 * 30
