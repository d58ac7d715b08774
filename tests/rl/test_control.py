"""A known control task by the trainer itself: `experiments/control.py`, shortened."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_ppo_learns_to_balance_a_pole(tmp_path: Path) -> None:
    """500 is the most; a policy that knows nothing gets about 20, three of three seeds here got 500."""
    output = tmp_path / "control.json"
    flags = ["--trainings", "cartpole-ppo", "--seeds", "0", "--iterations", "8", "--output", str(output)]
    result = subprocess.run(
        [sys.executable, "-m", "experiments.control", *flags], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr[-3000:]
    assert json.loads(output.read_text())["cartpole-ppo"]["seeds"][0]["score"] > 400
