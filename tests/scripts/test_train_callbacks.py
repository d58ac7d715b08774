"""lerobot-wmrl-train with gate, selection, Dyna rounds, wandb and --resume; and what it refuses."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
import wandb
import yaml
from lerobot.configs import parser
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from safetensors.torch import load_file

from lerobot_wmrl.common.checkpoints import link_checkpoint
from lerobot_wmrl.common.constants import START_SEED
from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.seeds import GATE_SEED
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.rl import recorders
from lerobot_wmrl.scripts.train import main
from tests.commands import run_here
from tests.rl.checkpoints import save_untrained_policy
from tests.rl.point_env import PointEnv

WEIGHTS = "pretrained_model/model.safetensors"
SHORT = [
    "--algorithm.type=ppo",
    "--num_envs=2",
    "--iterations=2",
    "--save_freq=2",
    "--algorithm.value_iterations=0",
]
POINT = ["--policy.path={pointing}", "--env.type=test_evaluable_point"]
IMAGINED = [
    "--env.type=world_model",
    "--env.world_model_path={action_world_model}",
    "--env.reward.type=general",
    "--env.reward.alpha=1",
    "--env.dataset.root={data}",
    "--env.episode_length=4",
    "--env.done_frames=1",
    "--env.device=cpu",
]
PUSH = ["--policy.path={pushing}", *IMAGINED]
ADAPTERS = ["--peft.method_type=LORA", "--peft.target_modules=[actor.0]"]
SIMULATOR = [
    "--real_env.type=wmrl_maniskill",
    "--real_env.image_size=32",
    "--real_env.episode_length=3",
    "--real_env.scenes=[0]",
    "--real_num_envs=1",
]


@EnvConfig.register_subclass("test_evaluable_point")
@dataclass
class EvaluablePointConfig(EnvConfig):
    """The point environment, drawn in 32x32 pixels: a world that is built at once."""

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_tensor_env(self, n_envs: int, device: str) -> PointEnv:
        return PointEnv(n_envs, horizon=4, image_size=32)


@pytest.fixture
def paths(trained_models: dict[str, Path], small_dataset: LeRobotDataset, tmp_path: Path) -> dict[str, Any]:
    """What flags may name: models, data, two policies, an output folder."""
    return {
        **trained_models,
        "data": small_dataset.root,
        "out": tmp_path / "rl",
        "pointing": save_untrained_policy(tmp_path / "pointing"),
        "pushing": save_untrained_policy(tmp_path / "pushing", actions=7),
    }


@pytest.fixture
def improve(paths: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Any:
    """The command in this process."""

    def call(*flags: str) -> Path:
        given = [flag.format(**paths) for flag in flags]
        monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *given])
        main()
        return paths["out"]

    return call


def test_selection_keeps_the_best_checkpoint(improve: Any) -> None:
    flags = [*POINT, *SHORT, "--output_dir={out}", "--selection.freq=1"]
    out = improve(*flags, "--selection.n_episodes=3")
    records = {
        int(path.parent.name): json.loads(path.read_text()) for path in out.glob("selection/*/record.json")
    }
    assert sorted(records) == [0, 1, 2]
    shares = {iteration: record["real"]["share"] for iteration, record in records.items()}
    assert (
        out / "checkpoints" / "best"
    ).resolve().name == f"{max(shares, key=lambda at: (shares[at], -at)):06d}"
    assert (out / "checkpoints" / "best" / WEIGHTS).is_file()
    written = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    improve(*flags, "--selection.n_episodes=3")
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == written
    best = (out / "checkpoints" / "best").resolve()
    other = next(out / "checkpoints" / name for name in ("000001", "000002") if name != best.name)
    link_checkpoint(other, "best")  # as a kill leaves it that comes before the last link
    improve(*flags, "--selection.n_episodes=3")
    assert (out / "checkpoints" / "best").resolve() == best


def test_a_run_is_resumed_as_lerobot_train_resumes(improve: Any, paths: dict[str, Any]) -> None:
    """By its configuration alone; what does not change the outcome may be another."""
    out = improve(*POINT, *SHORT, "--save_freq=1", "--output_dir={out}", "--policy.optimizer_lr=1e-5")
    last = out / "checkpoints" / "000002"
    weights = load_file(last / WEIGHTS)
    last.rename(out / "checkpoints" / ".000002.lost")
    configuration = out / "checkpoints" / "000001" / "pretrained_model" / "train_config.json"
    improve(f"--config_path={configuration}", "--resume=true", "--log_freq=2")
    resumed = load_file(last / WEIGHTS)
    assert all(torch.equal(resumed[name], value) for name, value in weights.items())
    assert [line["step"] for line in read_metrics(out)] == [1, 2]


def test_settings_of_the_policy_may_stand_in_a_file_and_flags_come_before_a_stored_run(
    improve: Any, paths: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kept in ("_config_path_args", "_config_yaml_overrides"):  # by LeRobot, until the process ends
        monkeypatch.setattr(parser, kept, {})
    given = {
        "policy": {
            "path": str(paths["pointing"]),
            "type": "cnn",
            "max_shift": 1,
            "optimizer_lr": 0.5,
            "tags": ["a", "b"],
            "license": None,
            "normalization_mapping": {"STATE": "MIN_MAX"},
        }
    }
    (tmp_path / "run.yaml").write_text(yaml.dump(given))
    flags = [*POINT[1:], *SHORT, "--output_dir={out}"]
    out = improve(f"--config_path={tmp_path / 'run.yaml'}", *flags)
    last = out / "checkpoints" / "last" / "pretrained_model"
    stored = json.loads((last / "config.json").read_text())
    assert (stored["max_shift"], stored["optimizer_lr"], stored["tags"]) == (1, 0.5, ["a", "b"])
    assert (stored["license"], stored["normalization_mapping"]["STATE"]) == (None, "MIN_MAX")
    new = f"--output_dir={tmp_path / 'new'}"
    improve(
        f"--config_path={out / 'train_config.json'}", f"--policy.path={last}", "--policy.license=mit", new
    )
    published = tmp_path / "new" / "checkpoints" / "last" / "pretrained_model" / "config.json"
    assert json.loads(published.read_text())["license"] == "mit"


def test_adapters_of_a_cnn_are_trained_beside_its_value_function(improve: Any) -> None:
    kept = "--algorithm.train_encoder=false"
    out = improve(*POINT, *SHORT, *ADAPTERS, kept, "--save_freq=1", "--output_dir={out}")
    first, last = (
        load_file(out / "checkpoints" / step / "pretrained_model" / "adapter_model.safetensors")
        for step in ("000001", "000002")
    )
    changed = {name for name, value in last.items() if not torch.equal(value, first[name])}
    assert {"critic", "lora_B"} <= {part for name in changed for part in name.split(".")}


def test_wandb_gets_what_the_metrics_file_gets(improve: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's logger, offline; a continued run goes on in the same one."""
    monkeypatch.setenv("WANDB_SILENT", "true")
    flags = [*POINT, *SHORT, "--output_dir={out}", "--wandb.enable=true"]
    out = improve(*flags, "--wandb.mode=offline", "--wandb.disable_artifact=true", "--selection.freq=2")
    wandb.finish()  # which waits until all is written
    runs = list((out / "wandb").glob("offline-run-*/*.wandb"))
    assert len(runs) == 1
    logged = runs[0].read_bytes()
    for name in (
        b"train/success_rate",
        b"train/kl",
        b"eval/selection/real/share",
        b"eval/real_steps/selection",
    ):
        assert name in logged, name


def test_the_gate_is_asked_before_the_first_update(improve: Any, capsys: pytest.CaptureFixture[str]) -> None:
    flags = [*PUSH, *SHORT, "--output_dir={out}", "--gate.dataset.root={data}"]
    with pytest.raises(SystemExit) as stopped:
        improve(*flags, "--env.done_threshold=0.0001")
    assert stopped.value.code == STOPPED
    assert "the world model calls failures successes" in capsys.readouterr().err
    out = improve(*flags, "--env.done_threshold=0.0001", "--gate.action=warn")
    assert (out / "checkpoints" / "last").resolve().name == "000002"
    assert [line["step"] for line in read_metrics(out)] == [0, 1, 2]
    assert read_metrics(out)[0]["gate/labelled/false_positive_rate/share"] == 1.0


def test_gate_and_selection_in_the_simulator(improve: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fresh rollouts are asked about, and real success stands beside imagined."""
    monkeypatch.setattr(recorders, "run_subcommand", lambda command: run_here(*command))
    out = improve(
        *PUSH,
        *SHORT,
        *SIMULATOR,
        "--output_dir={out}",
        "--gate.action=warn",
        "--gate.freq=0",
        "--gate.n_episodes=1",
        "--selection.freq=2",
        "--selection.n_episodes=1",
    )
    first, *_, last = read_metrics(out)
    assert (last["real_steps/gate"], last["real_steps/selection"]) == (3, 6)
    assert last["selection/real/n"] == last["selection/imagined/n"] == 1
    assert first["gate/fresh/false_positive_rate/n"] == 1
    assert (out / "gate" / "000000" / "fresh_failure.png").is_file()
    rollouts = read_episodes(open_dataset(out / "gate" / "000000" / "rollouts"))
    assert rollouts.columns[START_SEED].tolist() == [GATE_SEED]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (PUSH, "--gate.action=stop: no episode says what success is"),
        ([*PUSH, "--gate.action=halt"], "--gate.action=halt: choose one of stop"),
        ([*PUSH, "--gate.limit=2"], "--gate.limit=2"),
        ([*PUSH, "--env.done_frames=5"], "no episode could succeed"),
        ([*PUSH, *SIMULATOR, "--real_env.image_size=1"], "--real_env.image_size=1: must be at least 16"),
        ([*PUSH, *SIMULATOR, "--real_env.image_size=64"], "real_env has (3, 64, 64)"),
        ([*PUSH, *SIMULATOR, "--real_env.cameras=[wrist]"], "which real_env does not have"),
        ([*PUSH, *SIMULATOR, "--dyna.rounds=2"], "--dyna.rounds=2: there is room for 1"),
        (
            [*PUSH, "--gate.action=off", "--dyna.rounds=1"],
            "give an environment to record in (--real_env.type",
        ),
        (
            [
                *PUSH,
                "--gate.action=off",
                "--dyna.rounds=1",
                "--dyna.dataset.roots=[]",
                "--dyna.learnt.root={out}",
            ],
            "rl: no LeRobotDataset there",
        ),
        (
            [*PUSH, "--env.dataset.split=known", "--gate.action=off"],
            "--env.dataset.split=known: choose one of",
        ),
        ([*PUSH, "--env.device=cuda", "--gate.action=off"], "--env.device=cuda: the policy is on cpu"),
        (
            ["--policy.path={pointing}", *IMAGINED, "--gate.action=off"],
            "has 3 action components, the environ",
        ),
        ([*POINT, "--dyna.rounds=1"], "no world model to refresh"),
        ([*POINT, "--selection.freq=-1"], "--selection.freq=-1: must be at least 0"),
        ([*POINT, "--gate.dataset.root=D"], "--gate.dataset.root=D: is read in a world model alone"),
        ([*PUSH, "--gate.dataset.root=nowhere"], "--gate.dataset.root=nowhere: no LeRobotDataset there"),
        (
            [*POINT, "--selection.dataset.root=D"],
            "--selection.dataset.root=D: is read in a world model alone",
        ),
        ([*POINT, "--resume=true"], "--resume=true: there is no checkpoint in"),
        (
            [*POINT, "--algorithm.clipp=0.3"],
            "there is no flag --algorithm.clipp: did you mean --algorithm.clip?",
        ),
        ([*POINT, "--policy.shifts=1"], "unrecognized arguments: --shifts=1\nerror: --policy.path="),
        ([*POINT, "--num_envs=0"], "--num_envs=0: must be at least 1"),
        (
            [*POINT, *ADAPTERS, "--peft.full_training_modules=[encoder]"],
            "--peft.full_training_modules: adapters leave the value function",
        ),
        (
            [*POINT, *ADAPTERS, "--algorithm.initial_std=0.1"],
            "--algorithm.initial_std=0.1: is none of the adapters' parameters",
        ),
        (
            [
                *POINT,
                "--peft.method_type=LORA",
                "--peft.target_modules=.*encoder.*grid.*",
                "--algorithm.train_encoder=false",
            ],
            "--algorithm.train_encoder=false: leaves nothing of the policy to train",
        ),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(
    flags: list[str], message: str, improve: Any, paths: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        improve(*SHORT, "--output_dir={out}", *flags)
    assert stopped.value.code == 1
    assert message in capsys.readouterr().err
    assert not paths["out"].exists()


def test_other_settings_are_named_with_their_values(improve: Any, capsys: pytest.CaptureFixture[str]) -> None:
    flags = [*POINT, *SHORT, "--output_dir={out}"]
    improve(*flags)
    with pytest.raises(SystemExit):
        improve(*flags, "--iterations=3", "--algorithm.clip=0.1")
    said = capsys.readouterr().err
    assert (
        "(iterations 2 → 3; algorithm.clip 0.2 → 0.1)" in said
        or "algorithm.clip 0.2 → 0.1; iterations 2 → 3" in said
    )
