"""LeRobot finds every type with no extra flag, by its plugin discovery or by any import of the package."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent

STATEMENTS = (
    "import lerobot_wmrl",
    "from lerobot_wmrl.world_models.checkpoint import load_model",
    "import lerobot_policy_cnn.configuration_cnn",
    "import lerobot_policy_wm_mpc.configuration_wm_mpc",
)
REGISTERED = """
import json, os, sys
# what takes long, once for all
import datasets, diffusers.optimization, pandas, peft, scipy.stats, torchvision, transformers

assert not {"lerobot", "lerobot_wmrl"} & set(sys.modules)
for statement in sys.argv[1:]:
    if not os.fork():
        exec(statement)
        from lerobot.configs import PreTrainedConfig
        from lerobot.configs.rewards import RewardModelConfig
        from lerobot.envs.configs import EnvConfig
        from lerobot.rl.algorithms.configs import RLAlgorithmConfig
        bases = (PreTrainedConfig, RewardModelConfig, EnvConfig, RLAlgorithmConfig)
        simulators = [*({"mani_skill", "sapien", "mplib"} & set(sys.modules))]
        print(json.dumps([*([*base.get_known_choices()] for base in bases), simulators]), flush=True)
        os._exit(0)
    if os.waitstatus_to_exitcode(os.wait()[1]):
        sys.exit(statement)
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


@pytest.fixture(scope="module")
def registered() -> dict[str, list[list[str]]]:
    """What is registered after each statement, each in an interpreter that had not imported LeRobot."""
    command = [sys.executable, "-c", REGISTERED, *STATEMENTS]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]
    lines = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("[[")]
    return dict(zip(STATEMENTS, lines, strict=True))


@pytest.mark.parametrize("statement", STATEMENTS)
def test_any_import_registers_every_type(statement: str, registered: dict[str, list[list[str]]]) -> None:
    """The package alone imports no simulator for it."""
    *found, simulators = registered[statement]
    expected = (
        {"cnn", "openvla", "wm_mpc"},
        set(REWARD_MODELS),
        {"world_model", "wmrl_maniskill"},
        {"ppo", "grpo"},
    )
    for names, wanted in zip(found, expected, strict=True):
        assert wanted <= {*names}
    assert statement != "import lerobot_wmrl" or not simulators


def words(line: str) -> set[str]:
    return set(line.replace("{", " ").replace("}", " ").replace(",", " ").split())
