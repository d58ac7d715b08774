"""Sections of docs/results.md whose results are not published yet, from made-up ones."""

from typing import Any

from experiments.policy_sections import demo
from lerobot_wmrl.common.statistics import PairedChange, Proportion


def test_the_demo_s_section_says_what_ppo_added_to_the_rival() -> None:
    rate, change = Proportion(4, 10).as_json(), PairedChange(5, 1).as_json()
    run: dict[str, Any] = {
        "seed": 0,
        "seconds": 2400.0,
        "policies": {
            policy: {"known": rate, "unseen": rate, "imagined": rate}
            for policy in ("cloned", "filtered", "rl", "distilled")
        },
        "changes": {"known": change, "unseen": change},
        "replayed": {"filtered": {"false_positive_rate": rate}},
    }
    text = demo(lambda stem: {"demo": {"runs": [run]}}[stem])
    assert "Seed 0, 40 minutes: 5 gained, 1 lost (p = 0.2) in known scenes" in text
    assert "| 0 | cloned with successful rollouts | 40 % (17–69) | 40 % (17–69) | 40 % (17–69) |" in text
