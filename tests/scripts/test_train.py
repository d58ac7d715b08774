"""lerobot-train clones, lerobot-wmrl-train improves, lerobot-eval measures; and bad input is named."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.scripts.train import main
from lerobot_wmrl.tracking import read_metrics
from tests.rl.point_env import PointEnv

BIN = Path(sys.executable).parent
SIMULATOR = ["--env.type=wmrl_maniskill", "--env.image_size=32", "--env.episode_length=4"]
SHORT = [
    "--algorithm.type=ppo",
    "--num_envs=1",
    "--iterations=2",
    "--save_freq=1",
    "--algorithm.value_iterations=1",
]
POINT = ["--env.type=test_point"]


@EnvConfig.register_subclass("test_point")
@dataclass
class PointConfig(EnvConfig):
    """The point environment, drawn in 32x32 pixels: a world that is built at once."""

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_tensor_env(self, n_envs: int, device: str) -> PointEnv:
        return PointEnv(n_envs, horizon=4, image_size=32)


def run(program: str, *flags: str) -> None:
    result = subprocess.run([BIN / program, *flags], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-3000:]


def improve(monkeypatch: pytest.MonkeyPatch, *flags: str) -> None:
    """The command lerobot-wmrl-train, in this process."""
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *flags])
    main()


@pytest.fixture(scope="module")
def cloned(small_dataset: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of four steps of lerobot-train."""
    output_dir = tmp_path_factory.mktemp("clone") / "sft"
    run(
        "lerobot-train", "--policy.type=cnn", "--policy.push_to_hub=false", "--policy.device=cpu",
        "--dataset.repo_id=local/synthetic", f"--dataset.root={small_dataset.root}", "--steps=4",
        "--batch_size=4", "--num_workers=0", "--env_eval_freq=0", f"--output_dir={output_dir}",
    )  # fmt: skip
    return output_dir


def test_clone_improve_and_evaluate(cloned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output_dir = tmp_path / "rl"
    flags = [f"--policy.path={cloned}", *SIMULATOR, *SHORT, f"--output_dir={output_dir}"]
    improve(monkeypatch, *flags)
    lines = read_metrics(output_dir)
    assert [line["step"] for line in lines] == [1, 2]
    assert lines[0]["first_ratio_error"] < 1e-3
    assert all(line["episode_length"] <= 4 for line in lines)
    last = output_dir / "checkpoints" / "last" / "pretrained_model"
    run(
        "lerobot-eval", f"--policy.path={last}", *SIMULATOR, "--eval.n_episodes=1", "--eval.batch_size=1",
        "--seed=1000000", f"--output_dir={tmp_path / 'eval'}",
    )  # fmt: skip
    assert "pc_success" in json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]


def test_a_finished_training_is_left_alone(
    cloned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "checkpoints" / "000002").mkdir(parents=True)
    improve(monkeypatch, f"--policy.path={cloned}", *POINT, *SHORT, f"--output_dir={tmp_path}")
    assert not (tmp_path / "metrics.jsonl").exists()


def other_policy(folder: Path, camera: str = "third_view", size: int = 32, actions: int = 3) -> Path:
    """An untrained policy's checkpoint that wants something else of its environment."""
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, size, size))
    action = PolicyFeature(type=FeatureType.ACTION, shape=(actions,))
    config = CnnConfig(
        device="cpu",
        input_features={f"observation.images.{camera}": image},
        output_features={"action": action},
    )
    CnnPolicy(config).save_pretrained(folder)
    stats = {"action": {"mean": torch.zeros(actions), "std": torch.ones(actions)}}
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


@pytest.mark.parametrize(("wants", "message"), [
    ({"camera": "wrist"}, "needs observation.images.wrist"),
    ({"size": 64}, r"(3, 64, 64), the environment has (3, 32, 32)"),
    ({"actions": 5}, "5 action components, the environment 3"),
])  # fmt: skip
def test_a_policy_that_does_not_fit_the_environment_is_refused_before_training(
    wants: dict[str, int], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    policy = other_policy(tmp_path / "policy", **wants)
    output_dir = tmp_path / "rl"
    with pytest.raises(SystemExit) as stopped:
        improve(monkeypatch, f"--policy.path={policy}", *POINT, *SHORT, f"--output_dir={output_dir}")
    assert stopped.value.code == 1
    assert message in capsys.readouterr().err
    assert not output_dir.exists()


@pytest.mark.parametrize(("flags", "message"), [
    ([], "--policy.path: give the checkpoint"),
    (["--policy.path={tmp}/nothing_here"], "nothing_here"),
    (["--policy.path={tmp}/world_model"], "world_model: no policy can be loaded"),
    (["--policy.path={tmp}/truncated"], "truncated or of another version"),
    (["--policy.path={tmp}/whole", "--rollout_steps=2"], "--rollout_steps=2: episodes last up to 4"),
    (["--policy.path={tmp}/whole", "--output_dir={tmp}/whole"], "holds something else"),
    (["--policy.path={tmp}/whole", "--num_envs=0"], "--num_envs=0: must be at least 1"),
    (["--policy.path={tmp}/whole", "--algorithm.clip=0"], "algorithm.clip=0"),
    (["--policy.path={tmp}/whole", "--algorithm.initial_std=7"], "initial_std=7"),
])  # fmt: skip
def test_bad_input_is_named(
    flags: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    weights = other_policy(tmp_path / "whole") / "model.safetensors"
    truncated = other_policy(tmp_path / "truncated") / "model.safetensors"
    truncated.write_bytes(weights.read_bytes()[:20_000])
    (tmp_path / "world_model").mkdir()
    (tmp_path / "world_model" / "config.json").write_text('{"type": "action_world_model"}')
    before = sorted(tmp_path.rglob("*"))
    given = [flag.format(tmp=tmp_path) for flag in flags]
    with pytest.raises(SystemExit) as stopped:
        improve(monkeypatch, *POINT, *SHORT, f"--output_dir={tmp_path}/new", *given)
    assert stopped.value.code != 0
    assert message in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
