"""World models, rewards and reinforcement learning run without ManiSkill, SAPIEN and MPLib."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.tracking import read_metrics
from tests.rl.checkpoints import save_untrained_policy

ROOT = Path(__file__).parents[1]

TRAIN_WITHOUT_SIMULATOR = """
import sys

blocked = ("mani_skill", "sapien", "mplib", "trimesh", "fast_simplification", "transforms3d")
sys.modules |= dict.fromkeys(blocked)  # to import one of them raises ModuleNotFoundError

import lerobot_env_wmrl
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.scripts.train import main

config = WmrlManiSkillEnv(image_size=32)
for create in (config.create_envs, lambda n: config.create_tensor_env(n, "cpu")):
    try:
        create(2)
    except ValueError as error:
        assert ".[maniskill]" in str(error), error
    else:
        raise AssertionError("ManiSkill is blocked")
main()
"""


def test_ppo_in_a_world_model_runs_without_a_simulator(
    small_dataset: LeRobotDataset, trained_models: dict[str, Path], tmp_path: Path
) -> None:
    """With the general reward, so that both world models imagine."""
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    flags = [
        f"--policy.path={policy}",
        "--env.type=world_model",
        "--env.device=cpu",
        "--env.episode_length=4",
        f"--env.world_model_path={trained_models['action_world_model']}",
        f"--env.text_world_model_path={trained_models['text_world_model']}",
        f"--env.dataset.root={small_dataset.root}",
        "--algorithm.type=ppo",
        "--algorithm.value_iterations=0",
        "--num_envs=2",
        "--iterations=2",
        "--gate.action=off",
        f"--output_dir={tmp_path / 'rl'}",
    ]
    folders = os.pathsep.join(str(ROOT / folder) for folder in ("", "policies", "datasets", "robots"))
    result = subprocess.run(
        [sys.executable, "-c", TRAIN_WITHOUT_SIMULATOR, *flags],
        env={**os.environ, "PYTHONPATH": folders},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr[-3000:]
    assert [line["step"] for line in read_metrics(tmp_path / "rl")] == [1, 2]


def test_the_simulator_is_an_extra_of_the_installation() -> None:
    """And so is `opencv-python`, which SAPIEN asks for beside LeRobot's `opencv-python-headless`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = " ".join(project["dependencies"])
    for package in ("mani-skill", "sapien", "mplib"):
        assert package not in needed
        assert any(each.startswith(package) for each in project["optional-dependencies"]["maniskill"])
