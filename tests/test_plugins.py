"""LeRobot finds every type with no extra flag, by its plugin discovery or by any import of the package."""

import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent

REGISTERED = """
from lerobot.configs import PreTrainedConfig
from lerobot.configs.rewards import RewardModelConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
for base in (PreTrainedConfig, RewardModelConfig, EnvConfig, RLAlgorithmConfig):
    print(*base.get_known_choices())
import sys
print("built", *({"mani_skill", "sapien", "mplib"} & set(sys.modules)))
"""
REWARD_MODELS = ("frame_tokenizer", "action_world_model", "text_world_model", "general", "embedding", "proxy")


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


@pytest.mark.parametrize(
    "statement",
    [
        "import lerobot_wmrl",
        "from lerobot_wmrl.world_models.checkpoint import load_model",
        "import lerobot_policy_cnn.configuration_cnn",
        "import lerobot_policy_wm_mpc.configuration_wm_mpc",
    ],
)
def test_any_import_registers_every_type(statement: str) -> None:
    """The package alone imports no simulator for it."""
    result = subprocess.run(
        [sys.executable, "-c", f"{statement}\n{REGISTERED}"], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr[-2000:]
    *registered, built = result.stdout.splitlines()[-5:]
    expected = (
        {"cnn", "openvla", "wm_mpc"}, set(REWARD_MODELS), {"world_model", "wmrl_maniskill"}, {"ppo", "grpo"},
    )  # fmt: skip
    for names, wanted in zip(registered, expected, strict=True):
        assert wanted <= set(names.split())
    assert statement != "import lerobot_wmrl" or built == "built"


def words(line: str) -> set[str]:
    return set(line.replace("{", " ").replace("}", " ").replace(",", " ").split())
