"""A known control task by the trainer itself: `experiments/steps/control.py`, shortened."""

import json
import sys
from pathlib import Path

import pytest

from experiments.steps import control


def test_ppo_learns_to_balance_a_pole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """500 is the most; a policy that knows nothing gets about 20, three of three seeds here got 500."""
    output = tmp_path / "control.json"
    flags = ["--trainings", "cartpole-ppo", "--seeds", "0", "--iterations", "8", "--output", str(output)]
    monkeypatch.setattr(sys, "argv", ["control", *flags])
    control.main()
    assert json.loads(output.read_text())["cartpole-ppo"]["seeds"][0]["score"] > 400
