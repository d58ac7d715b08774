"""The study of a simulator that nothing here was built for: joined comparisons, and the section."""

import json
from pathlib import Path
from typing import Any

from experiments.compare_in_parts import joined
from experiments.foreign import POLICIES, TIMED, section
from experiments.success import rate

OUTCOMES = {
    "cloned": [True, False, False, False],
    "filtered": [True, True, False, False],
    "improve": [True, True, True, True],
}


def test_parts_are_joined_in_the_order_of_the_starts(tmp_path: Path) -> None:
    parts = []
    for part, successes in enumerate([[[True, False]], [[False, True], [True, True]]]):
        episodes = [{"seed": 10 * part + at, "successes": each} for at, each in enumerate(successes)]
        parts.append(tmp_path / f"{part}.json")
        parts[-1].write_text(json.dumps({"policies": {"a": {}, "b": {}}, "episodes": episodes}))
    assert joined(parts) == {"a": [True, False, True], "b": [False, True, True]}


def test_the_section_compares_the_improved_policy_with_both_clones() -> None:
    def load(stem: str) -> dict[str, Any]:
        seed = int(stem.removeprefix("metaworld/seed"))
        if seed == 2:
            raise FileNotFoundError(stem)
        return {
            "task": "push-v3", "episodes": 40, "noise": "0.0 0.4", "rollouts": 150, "iterations": 60,
            "seed": seed,
            "minutes": dict.fromkeys(TIMED, 2.0),
            "policies": {name: rate(OUTCOMES[name]) for name in POLICIES},
        }  # fmt: skip

    text = section(load)
    assert text.count("| 2 of 4, 50 % ") == 2, "one row a seed that is published"
    assert "100 %: 2 gained, 0 lost" in text
    assert "improved, against the one cloned from the expert's episodes |  | +75.0 points" in text
    assert "4.0 minutes to record, 4.0 to clone twice" in text
