"""The study of a simulator that nothing here was built for: what is collected, and the section."""

from pathlib import Path
from typing import Any

from experiments.page.foreign import section
from experiments.steps.foreign import POLICIES, TIMED, metaworld
from experiments.steps.success import rate
from experiments.study import Study
from lerobot_wmrl.common.files import write_json

OUTCOMES = {
    "cloned": [True, False, False, False],
    "further": [True, True, False, False],
    "longer": [True, False, True, False],
    "improve": [True, True, True, True],
}


def test_a_finished_seed_is_collected(tmp_path: Path) -> None:
    variables = {"task": "push-v3", "episodes": 40, "noise": "0.0", "rollouts": 9, "iterations": 6, "seed": 1}
    for step in TIMED:
        write_json(tmp_path / "steps" / f"{step}.json", {"seconds": 90})
    episodes = [{"successes": list(each)} for each in zip(*OUTCOMES.values(), strict=True)]
    write_json(tmp_path / "comparison" / "comparison.json", {"episodes": episodes})
    write_json(tmp_path / "improve" / "check" / "metrics.json", {"auc": 0.9})
    variables |= {"output_dir": str(tmp_path), "cell": "seed1"}
    (found,) = metaworld(Study("metaworld", "?", {}, variables, (), None, ())).values()
    assert found["minutes"] == dict.fromkeys(TIMED, 1.5)
    assert {name: each["k"] for name, each in found["policies"].items()} == {
        "cloned": 1,
        "further": 2,
        "longer": 2,
        "improve": 4,
    }
    assert found["check"] == {"auc": 0.9}
    assert (found["rollouts"], found["seed"]) == (9, 1)


def test_the_section_compares_the_improved_policy_with_both_clones() -> None:
    def load(stem: str) -> dict[str, Any]:
        seed = int(stem.removeprefix("metaworld/seed"))
        if seed == 5:
            raise FileNotFoundError(stem)
        return {
            "task": "push-v3",
            "episodes": 40,
            "noise": "0.0 0.4",
            "rollouts": 150,
            "iterations": 60,
            "seed": seed,
            "minutes": dict.fromkeys(TIMED, 2.0),
            "policies": {name: rate(OUTCOMES[name]) for name in POLICIES},
        }

    text = section(load)
    assert text.count("| 2 of 4, 50 % ") == 4, "two rows a seed that is published"
    assert "100 %: 2 gained, 0 lost" in text
    assert "improved, against the one cloned from the expert's episodes |  | +75.0 points" in text
    assert "2.0 minutes to record, 2.0 to clone, 2.0 to improve" in text
