"""lerobot-train clones, lerobot-wmrl-train improves, lerobot-eval measures; and bad input is named."""

import json
import shutil
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

from lerobot_wmrl.common.output_folders import LOCK, hold_lock
from lerobot_wmrl.common.presets import PRESETS
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import RuleBasedReward
from lerobot_wmrl.rl.compatibility import rollout_length, settle_discount, warn_of_discount
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.rl.trained_policy import evaluation
from lerobot_wmrl.scripts.train import main
from tests.commands import run_here
from tests.hub_server import Hub
from tests.rl.checkpoints import save_untrained_policy
from tests.scripts.point_config import PointConfig

SIMULATOR = ["--env.type=wmrl_maniskill", "--env.image_size=32", "--env.episode_length=4"]
SHORT = [
    "--algorithm.type=ppo",
    "--num_envs=1",
    "--iterations=2",
    "--save_freq=1",
    "--algorithm.value_iterations=1",
]
POINT = ["--env.type=test_point"]


def improve(monkeypatch: pytest.MonkeyPatch, *flags: str) -> None:
    """The command lerobot-wmrl-train, in this process."""
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *flags])
    main()


@pytest.fixture(scope="module")
def cloned(small_dataset: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of four steps of lerobot-train."""
    output_dir = tmp_path_factory.mktemp("clone") / "sft"
    run_here(
        "lerobot-train",
        "--policy.type=cnn",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--dataset.repo_id=local/synthetic",
        f"--dataset.root={small_dataset.root}",
        "--steps=4",
        "--batch_size=4",
        "--num_workers=0",
        "--env_eval_freq=0",
        f"--output_dir={output_dir}",
    )
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
    flags = [f"--policy.path={last}", *SIMULATOR, "--eval.n_episodes=1", "--eval.batch_size=1"]
    run_here("lerobot-eval", *flags, "--seed=1000000", f"--output_dir={tmp_path / 'eval'}")
    assert "pc_success" in json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_trains_for_four_iterations_with_few_environments(
    preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ["--num_envs=2", "--iterations=4", "--algorithm.minibatch_size=4", "--gate.action=off"]
    policy = save_untrained_policy(tmp_path / "policy")
    flags = [f"--preset={preset}", f"--policy.path={policy}", *POINT, *few, f"--output_dir={tmp_path / 'rl'}"]
    improve(monkeypatch, *flags)
    assert [line["step"] for line in read_metrics(tmp_path / "rl")] == [1, 2, 3, 4]


def test_a_finished_training_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = save_untrained_policy(tmp_path / "policy")
    flags = [f"--policy.path={policy}", *SHORT, f"--output_dir={tmp_path / 'rl'}"]
    improve(monkeypatch, *flags, *POINT)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    improve(monkeypatch, *flags, *POINT)
    with pytest.raises(SystemExit) as stopped:
        improve(monkeypatch, *flags, *POINT, "--seed=5")
    assert stopped.value.code == 1
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_another_policy_of_the_same_name_does_not_continue_a_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = save_untrained_policy(tmp_path / "policy")
    flags = [f"--policy.path={policy}", *SHORT, *POINT, f"--output_dir={tmp_path / 'rl'}"]
    improve(monkeypatch, *flags)
    save_untrained_policy(policy, constant=0.01)
    with pytest.raises(SystemExit):
        improve(monkeypatch, *flags)
    assert "was begun with another content of policy, under the same name" in capsys.readouterr().err


def test_a_training_that_another_command_continues_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, output_dir = save_untrained_policy(tmp_path / "policy"), tmp_path / "rl"
    flags = [f"--policy.path={policy}", *SHORT, f"--output_dir={output_dir}", *POINT]
    improve(monkeypatch, *flags)
    shutil.rmtree(output_dir / "checkpoints" / "000002")
    with hold_lock(output_dir, output_dir / LOCK), pytest.raises(SystemExit):
        improve(monkeypatch, *flags)
    assert "another command writes there" in capsys.readouterr().err
    assert not (output_dir / "checkpoints" / "000002").exists()


def test_an_interrupted_training_ends_as_if_nothing_had_happened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = save_untrained_policy(tmp_path / "policy")
    checkpoints = tmp_path / "rl" / "checkpoints"
    flags = [f"--policy.path={policy}", *SHORT, f"--output_dir={tmp_path / 'rl'}", *POINT]
    improve(monkeypatch, *flags)
    uninterrupted = load_file(checkpoints / "last" / "pretrained_model" / "model.safetensors")
    shutil.rmtree(checkpoints / "000002")
    improve(monkeypatch, *flags)
    continued = load_file(checkpoints / "last" / "pretrained_model" / "model.safetensors")
    assert all(torch.equal(tensor, continued[name]) for name, tensor in uninterrupted.items())


def test_it_says_what_it_made_and_publishes_it_if_asked(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Never where the SFT policy was published, although its configuration says so."""
    policy = save_untrained_policy(tmp_path / "policy")
    settings = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps({**settings, "push_to_hub": True, "repo_id": "me/sft"}))
    out = tmp_path / "rl"
    flags = [f"--policy.path={policy}", *POINT, *SHORT, f"--output_dir={out}"]
    improve(monkeypatch, *flags)
    told = capsys.readouterr().out
    assert f"{out}: cnn policy after 2 iterations of PPO, 8 steps in test_point" in told
    assert "success in test_point with exploration: " in told
    last = out / "checkpoints" / "last" / "pretrained_model"
    assert f"next: lerobot-eval --policy.path={last} --env.type=test_point" in told
    assert not hub.repos
    with monkeypatch.context() as nobody:
        nobody.setattr("lerobot_wmrl.common.hub.get_token", lambda: None)
        with pytest.raises(SystemExit):
            improve(nobody, *flags, "--policy.push_to_hub=true", "--policy.repo_id=me/improved")
    assert "--policy.push_to_hub=true: nobody is logged in to the hub here" in capsys.readouterr().err
    improve(monkeypatch, *flags, "--policy.push_to_hub=true", "--policy.repo_id=me/improved")
    published = hub.repos["models", "me/improved"].head
    assert published["model.safetensors"] == (last / "model.safetensors").read_bytes()
    assert {"config.json", "policy_preprocessor.json", "train_config.json"} <= published.keys()
    card = published["README.md"].decode()
    assert "library_name: lerobot" in card
    assert "2 iterations of PPO" in card
    assert "It began as a policy that is not published." in card
    assert "lerobot-eval --policy.path=me/improved --env.type=test_point" in card
    assert str(tmp_path) not in card
    assert list(hub.repos) == [("models", "me/improved")]


def test_a_command_for_others_names_no_folder_of_this_machine(trained_models: dict[str, Path]) -> None:
    world_model = str(trained_models["action_world_model"])
    reward = GeneralConfig(alpha=1)
    settings = WorldModelEnv(
        world_model_path=world_model, dataset=StartFrames(root="me/frames"), reward=reward
    )
    cfg: Any = SimpleNamespace(real_env=None, env=settings)
    assert f"--env.world_model_path={world_model}" in evaluation(cfg, "me/improved")
    command = evaluation(cfg, "me/improved", shared=True)
    assert world_model not in command
    assert "--env.world_model_path=FOLDER --env.dataset.root=me/frames" in command


def test_grpo_trains_by_the_same_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, output_dir = save_untrained_policy(tmp_path / "policy"), tmp_path / "rl"
    flags = [
        f"--policy.path={policy}",
        *POINT,
        f"--output_dir={output_dir}",
        "--iterations=2",
        "--num_envs=8",
    ]
    grpo = ["--algorithm.type=grpo", "--algorithm.group_size=4", "--algorithm.least_group_std=1e-3"]
    improve(monkeypatch, *flags, *grpo)
    lines = read_metrics(output_dir)
    assert [line["step"] for line in lines] == [1, 2]
    assert all(line["updates"] > 0 and line["groups_with_signal"] == 1 for line in lines)
    assert "value_loss" not in lines[0]


def test_a_finished_training_of_something_else_is_refused(
    cloned: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        improve(monkeypatch, f"--policy.path={cloned}", *POINT, *SHORT, f"--output_dir={cloned}")
    assert stopped.value.code == 1
    assert "holds something else" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--policy.path={tmp}/policy", *POINT], "needs observation.images.wrist, which"),
        (["--policy.path={tmp}/policy", *POINT, "--output_dir={tmp}/policy"], "holds something else"),
        (["--policy.path={tmp}/policy", *POINT, "--algorithm.clip=0"], "--algorithm.clip=0"),
        (POINT, "--policy.path: give the checkpoint"),
        (["--policy.path={tmp}/policy", *POINT, "--policy.push_to_hub=true"], "hub, --policy.repo_id"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(
    flags: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    save_untrained_policy(tmp_path / "policy", camera="third_view" if "holds" in message else "wrist")
    before = sorted(tmp_path.rglob("*"))
    given = [flag.format(tmp=tmp_path) for flag in flags]
    with pytest.raises(SystemExit) as stopped:
        improve(monkeypatch, *SHORT, f"--output_dir={tmp_path}/new", *given)
    assert stopped.value.code == 1
    assert message in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"env": None}, r"env\.type"),
        ({"num_envs": 0}, "num_envs=0"),
        ({"seed": -1}, "seed=-1"),
        ({"seed": 1_000_000}, "seed=1000000"),
        ({"num_envs": 12, "algorithm": GRPOConfig(group_size=8)}, r"num_envs=12: must be a multiple of"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrainConfig(**{"env": PointConfig(), **settings}).validate()


@pytest.mark.parametrize(
    ("flags", "warned"),
    [
        ({}, False),
        ({"gamma": 0.9}, True),
        ({"gamma": 0.9, "reward": RuleBasedReward(gamma=0.9)}, False),
        ({"gamma": 0.9, "reward": RuleBasedReward(alpha=1.0)}, False),
        ({"gamma": 0.9, "reward": RuleBasedReward(form="absolute")}, False),
    ],
)
def test_another_discount_of_progress_than_ppos_is_warned_of(
    flags: dict[str, Any], warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    env = WmrlManiSkillEnv(reward=flags.get("reward", RuleBasedReward()))
    cfg = TrainConfig(env=env, algorithm=PPOConfig(gamma=flags.get("gamma")))
    warn_of_discount(cfg, longest=60)
    assert ("env.reward.gamma=0.98: progress" in caplog.text) == warned
    assert ("set --env.reward.gamma=0.9" in caplog.text) == warned


def test_grpo_pays_for_progress_without_a_discount(caplog: pytest.LogCaptureFixture) -> None:
    """It adds rewards up: of two failures the one that came nearer then has the larger return."""
    env = WmrlManiSkillEnv()
    cfg = TrainConfig(env=env, algorithm=GRPOConfig())
    settle_discount(cfg)
    warn_of_discount(cfg, longest=40)
    assert not caplog.text
    for level in (0.2, 0.8):
        path = [0.0, *[level] * 40]
        rewards = [env.reward.step_reward(0.0, now, before, 40) for before, now in pairwise(path)]
        assert sum(rewards) == pytest.approx(0.1 * level)
    given = TrainConfig(env=WmrlManiSkillEnv(reward=RuleBasedReward(gamma=0.9)), algorithm=GRPOConfig())
    settle_discount(given)
    warn_of_discount(given, longest=40)
    assert "env.reward.gamma=0.9: progress is rewarded with this discount, and GRPO has 1.0" in caplog.text


def test_a_rollout_reaches_the_end_of_an_episode() -> None:
    assert rollout_length(TrainConfig(), longest=4) == 4
    with pytest.raises(ValueError, match=r"rollout_steps=2: episodes last up to 4"):
        rollout_length(TrainConfig(rollout_steps=2), longest=4)
