"""LoRA from lerobot-train to lerobot-wmrl-train, lerobot-eval and the export."""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import make_policy
from safetensors.torch import load_file

from lerobot_policy_openvla.actions import dataset_statistics
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_policy_openvla.processor_openvla import make_openvla_pre_post_processors
from lerobot_wmrl.common.policies import (
    check_weights,
    frozen_copy,
    load_policy,
    load_processors,
    read_policy_config,
    unwrapped,
)
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.findings import inspect_dataset
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.scripts.convert_openvla import ConvertOpenVLAConfig, convert
from lerobot_wmrl.scripts.train import main
from tests.commands import run_here
from tests.improve.made_up import commands_of
from tests.lerobot_policy_openvla.small import observe, small_policy
from tests.rl.point_env import PointEnv

ADAPTERS = "adapter_model.safetensors"
SHORT = [
    "--algorithm.type=ppo",
    "--num_envs=2",
    "--iterations=3",
    "--save_freq=1",
    "--algorithm.value_iterations=1",
    "--algorithm.minibatch_size=4",
    "--algorithm.policy_lr=1e-2",
]
LAST = Path("checkpoints/last/pretrained_model")


@EnvConfig.register_subclass("test_seven_points")
@dataclass
class SevenPointsConfig(EnvConfig):
    """The point environment with the dataset's seven action components, drawn in 32x32 pixels."""

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_tensor_env(self, n_envs: int, device: str) -> PointEnv:
        return PointEnv(n_envs, horizon=4, image_size=32, actions=7)


def improve(
    monkeypatch: pytest.MonkeyPatch,
    policy: Path,
    output_dir: Path,
    *flags: str,
    env: str = "test_seven_points",
) -> None:
    """The command lerobot-wmrl-train, in this process."""
    paths = [f"--policy.path={policy}", f"--output_dir={output_dir}"]
    arguments = [*paths, f"--env.type={env}", *SHORT, *flags]
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *arguments])
    main()


def load(folder: Path) -> Any:
    return load_policy(read_policy_config(str(folder), []))


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that knows another dataset's statistics, as an import leaves it."""
    folder = tmp_path_factory.mktemp("base")
    other = {"action": {"q01": [-9.0] * 7, "q99": [9.0] * 7, "mask": [True] * 7}}
    output = PolicyFeature(type=FeatureType.ACTION, shape=(7,))
    policy = small_policy(
        norm_stats={"other": other}, unnorm_key="other", input_features={}, output_features={"action": output}
    )
    policy.save_pretrained(folder)
    for processor in make_openvla_pre_post_processors(policy.config):
        processor.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def tuned(base: Path, small_dataset: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of four steps of lerobot-train with LoRA."""
    output_dir = tmp_path_factory.mktemp("tuned") / "sft"
    run_here(
        "lerobot-train",
        f"--policy.path={base}",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--peft.method_type=LORA",
        "--peft.r=4",
        "--peft.lora_alpha=8",
        "--dataset.repo_id=local/synthetic",
        f"--dataset.root={small_dataset.root}",
        "--steps=4",
        "--batch_size=4",
        "--num_workers=0",
        "--env_eval_freq=0",
        f"--output_dir={output_dir}",
    )
    return output_dir


def test_fine_tuning_writes_adapters_and_the_datasets_statistics(
    tuned: Path, small_dataset: LeRobotDataset
) -> None:
    weights = load_file(tuned / LAST / ADAPTERS)
    assert not (tuned / LAST / "model.safetensors").exists()
    assert any(value.any() for name, value in weights.items() if "lora_B" in name)
    config = read_policy_config(str(tuned), [])
    assert config.unnorm_key == "local/synthetic"
    statistics = dataset_statistics(LeRobotDatasetMetadata("local/synthetic", root=small_dataset.root))
    assert statistics is not None
    assert config.norm_stats["local/synthetic"] == statistics
    assert config.norm_stats["other"]["action"]["q99"] == [9.0] * 7
    _, postprocess = load_processors(config)
    lowest = postprocess(torch.full((1, 7), 575))[0]
    assert torch.allclose(lowest[:6], torch.tensor(statistics["action"]["q01"])[:6], atol=1e-3)
    assert lowest[6] == pytest.approx(-1, abs=1 / 255)


def test_adapters_are_trained_further_as_the_command_improve_does_it(
    tuned: Path, small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    config = ImproveConfig(
        policy=read_policy_config(str(tuned), []),
        dataset=ChosenEpisodes(str(small_dataset.root)),
        size="tiny",
        output_dir=tmp_path,
    )
    found = inspect_dataset(read_episodes(small_dataset), config.policy, None)
    command = commands_of(Progress(Plan(config, found)), "cloned")["cloned"]
    run_here(*command, "--policy.device=cpu", "--steps=2", "--save_freq=2")
    before, after = (load_file(folder / LAST / ADAPTERS) for folder in (tuned, tmp_path / "cloned"))
    assert after.keys() == before.keys()
    assert any(not torch.equal(after[name], value) for name, value in before.items() if "lora_B" in name)
    assert load(tmp_path / "cloned").select_action(observe()).shape == (4, 7)


def test_improve_reload_and_evaluate(tuned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only adapters and value are trained and saved; LeRobot and this project load them alike."""
    before = load_file(tuned / LAST / ADAPTERS)
    improve(monkeypatch, tuned, tmp_path / "rl")
    assert [line["step"] for line in read_metrics(tmp_path / "rl")] == [1, 2, 3]
    assert all(line["first_ratio_error"] < 1e-3 for line in read_metrics(tmp_path / "rl"))
    after = load_file(tmp_path / "rl" / LAST / ADAPTERS)
    assert after.keys() == before.keys()
    for part in ("lora_B", "value_head"):
        assert any(not torch.equal(after[name], value) for name, value in before.items() if part in name)
    improved = load(tmp_path / "rl")
    state = {name: value for name, value in improved.state_dict().items() if "lora" in name}
    assert all(torch.equal(after[name.replace(".default", "")], value) for name, value in state.items())
    config = read_policy_config(str(tmp_path / "rl"), [])
    check_weights(config)
    lerobots = make_policy(config, env_cfg=EnvConfig.get_choice_class("wmrl_maniskill")(image_size=32))
    assert torch.equal(lerobots.eval().select_action(observe()), improved.select_action(observe()))
    assert torch.equal(lerobots.value(observe()), improved.value(observe()))
    assert not torch.equal(improved.value(observe()), load(tuned).value(observe()))
    run_here(
        "lerobot-eval",
        f"--policy.path={tmp_path / 'rl' / LAST}",
        "--env.type=wmrl_maniskill",
        "--env.image_size=32",
        "--env.episode_length=4",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--seed=1000000",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert "pc_success" in json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]


def test_an_interrupted_training_of_adapters_ends_as_if_nothing_had_happened(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """New adapters on a policy that no dataset has tuned."""
    flags = ("--peft.method_type=LORA", "--peft.r=2")
    improve(monkeypatch, base, tmp_path, *flags)
    uninterrupted = load_file(tmp_path / LAST / ADAPTERS)
    shutil.rmtree(tmp_path / "checkpoints" / "000003")
    improve(monkeypatch, base, tmp_path, *flags)
    continued = load_file(tmp_path / LAST / ADAPTERS)
    assert all(torch.equal(value, continued[name]) for name, value in uninterrupted.items())
    improve(monkeypatch, base, tmp_path, *flags)


@pytest.mark.parametrize("ratio", ["action", "token"])
def test_adapters_are_improved_in_the_world_model(
    tuned: Path,
    trained_models: dict[str, Path],
    small_dataset: LeRobotDataset,
    ratio: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    improve(
        monkeypatch,
        tuned,
        tmp_path,
        f"--env.world_model_path={trained_models['action_world_model']}",
        "--env.reward.type=general",
        "--env.reward.alpha=1",
        f"--env.dataset.root={small_dataset.root}",
        "--env.episode_length=3",
        "--iterations=2",
        f"--algorithm.ratio={ratio}",
        "--gate.action=off",
        "--algorithm.target_kl=1",
        env="world_model",
    )
    lines = read_metrics(tmp_path)
    assert lines[1]["first_ratio_error"] < 1e-3
    assert lines[1]["kl"] > 0


def test_the_reference_shares_what_is_frozen(tuned: Path) -> None:
    """So PPO's reference costs adapters, not a second network."""
    policy = load(tuned)
    copies = zip(policy.named_parameters(), frozen_copy(policy).parameters(), strict=True)
    for (name, parameter), copied in copies:
        assert (copied is parameter) == (not parameter.requires_grad), name
        assert torch.equal(copied, parameter)


@pytest.mark.parametrize("new", [False, True])
def test_adapters_of_a_policy_that_others_lack_are_not_published(
    new: bool,
    base: Path,
    tuned: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """They would name a folder of this machine; said before anything is trained."""
    flags = ["--policy.push_to_hub=true", "--policy.repo_id=me/adapters", *(["--peft.r=2"] if new else [])]
    with pytest.raises(SystemExit):
        improve(monkeypatch, base if new else tuned, tmp_path / "new", *flags)
    said = capsys.readouterr().err
    assert f"--policy.push_to_hub=true: the adapters belong to the policy in {base}" in said
    assert not (tmp_path / "new").exists()


def test_new_adapters_on_adapters_are_refused(
    tuned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        improve(monkeypatch, tuned, tmp_path / "new", "--peft.r=2")
    assert "--peft: the policy has adapters, which are trained further" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_the_export_holds_the_adapters(tuned: Path, tmp_path: Path) -> None:
    convert(ConvertOpenVLAConfig("export", str(tuned), tmp_path / "out"))
    merged = OpenVLAPolicy.from_openvla(tmp_path / "out", unnorm_key="local/synthetic")
    adapted = unwrapped(load(tuned))
    ids = adapted.select_action(observe())
    with torch.no_grad():
        states = [policy.model.states(policy._observed(observe()), ids) for policy in (merged, adapted)]
        plain = small_policy()
        unadapted = plain.model.states(plain._observed(observe()), ids)
    assert torch.allclose(*states, atol=1e-4)
    assert not torch.allclose(states[0], unadapted, atol=1e-3)
    statistics = json.loads((tmp_path / "out" / "dataset_statistics.json").read_text())
    assert statistics["local/synthetic"]["num_trajectories"] == 6


def test_a_base_that_is_gone_is_named(tuned: Path, base: Path, tmp_path: Path) -> None:
    folder = tmp_path / "moved"
    shutil.copytree(tuned / LAST, folder)
    settings = json.loads((folder / "adapter_config.json").read_text())
    for gone in (str(tmp_path / "gone"), "outputs/gone/checkpoints"):
        settings["base_model_name_or_path"] = gone
        (folder / "adapter_config.json").write_text(json.dumps(settings))
        with pytest.raises(ValueError, match=rf"adapts the policy in {gone}, which is not there"):
            load(folder)
    (folder / ADAPTERS).write_bytes((folder / ADAPTERS).read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"adapter_model\.safetensors cannot be read"):
        check_weights(read_policy_config(str(folder), []))
