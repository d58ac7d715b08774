"""LeRobot's own commands find every policy, reward model and environment with no extra flag."""

import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent


@pytest.mark.parametrize(
    ("command", "types"),
    [
        (
            "lerobot-train",
            ("cnn", "openvla", "action_world_model", "text_world_model", "world_model", "wmrl_maniskill"),
        ),
        ("lerobot-eval", ("cnn", "openvla", "world_model", "wmrl_maniskill")),
    ],
)
def test_lerobot_accepts_our_types(command: str, types: tuple[str, ...], tmp_path: Path) -> None:
    """Run away from the repository, so that only the installed metadata can make it work."""
    result = subprocess.run([BIN / command, "--help"], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]
    choices = {choice for line in result.stdout.splitlines() if ".type" in line for choice in words(line)}
    assert set(types) <= choices


def words(line: str) -> set[str]:
    return set(line.replace("{", " ").replace("}", " ").replace(",", " ").split())
