"""Sections of docs/results.md whose results are not published yet, from made-up ones."""

from typing import Any

from experiments.page.policies import demo
from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.improve.progress import CLONED, DISTILLED, SFT


def test_the_demo_s_section_says_what_ppo_added_to_the_rival() -> None:
    rate, change = Proportion(4, 10).as_json(), PairedChange(5, 1).as_json()
    run: dict[str, Any] = {
        "seed": 0,
        "seconds": 2400.0,
        "places": {
            "in known scenes": {
                "policies": dict.fromkeys((SFT, CLONED, DISTILLED), rate),
                "pairs": [
                    {"after": CLONED, "before": SFT, "gained": 9, "lost": 9, "p_value": 1.0},
                    {"after": DISTILLED, "before": CLONED, **change},
                ],
            }
        },
        "gate": {"false_positive_rate": rate},
    }
    text = demo(lambda stem: {"demo": {"runs": [run]}}[stem])
    assert "Seed 0, 40 minutes: in known scenes 5 gained, 1 lost (p = 0.2)" in text
    assert "begins with, the world model predicts 4 of 10, 40 % (17–69) as successes" in text
    assert f"| 0 | {CLONED} | 40 % (17–69) |" in text
