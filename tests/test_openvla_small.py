"""benchmarks/openvla_small.py: commands that the programs understand, in an order that works."""

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.demo.stages import checkpoint
from lerobot_wmrl.scripts.train import TrainConfig

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
VIEWS = ("third_view", "side_view")
MEASURED = ("ind", "ood", "drawn")
RATES = {"recall": {"share": 0.9}, "false_positive_rate": {"share": 0.1}}


@pytest.fixture
def make_experiment(
    tmp_path: Path, make_synthetic_dataset: Callable[..., LeRobotDataset], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """Of a gate that has recorded three demonstrations of each kind."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    gate = tmp_path / "gate"
    for name, cameras in (("planned", VIEWS), ("good", VIEWS[1:])):
        make_synthetic_dataset(gate / name, cameras=cameras, size=64)
    sweep = [{"done_threshold": 0.5, "done_frames": 2, **RATES}]
    (gate / "check").mkdir()
    (gate / "check" / "metrics.json").write_text(json.dumps({"gate_sweep": sweep}))

    def make(imagined: Path | None = None) -> Any:
        module = importlib.import_module("openvla_small")
        return module.Experiment(gate, tmp_path / "out", imagined, (3, 2), (5, 4), 6, 7, ["--seed=8"])

    return make


def flags_of(command: list[str]) -> dict[str, str]:
    """Of what is given twice, the last."""
    return dict(flag.removeprefix("--").split("=", 1) for flag in command[1:])


def test_the_stages_go_from_nothing_to_a_policy_that_is_measured_twice(
    make_experiment: Callable[..., Any], tmp_path: Path
) -> None:
    measured = {
        kind: [f"eval_{kind}_openvla_{where}" for where in MEASURED] for kind in ("cloned", "imagined")
    }
    rest = [*measured["cloned"], "imagined_openvla", *measured["imagined"]]
    first = ["pretrained", "adapted"]
    assert [stage.name for stage in make_experiment().stages()] == [*first, "text_world_model", *rest]
    stages = {stage.name: flags_of(stage.command()) for stage in make_experiment(tmp_path / "ppo").stages()}
    assert list(stages) == [*first, *rest]
    out = tmp_path / "out"
    assert stages["adapted"]["policy.path"] == str(checkpoint(out / "pretrained"))
    assert stages["imagined_openvla"]["policy.path"] == str(checkpoint(out / "adapted"))
    assert stages["imagined_openvla"]["env.text_world_model_path"] == str(tmp_path / "ppo/text_world_model")
    for kind, folder in (("cloned", "adapted"), ("imagined", "imagined_openvla")):
        found = [stages[name] for name in measured[kind]]
        assert {each["policy.path"] for each in found} == {str(checkpoint(out / folder))}
        assert {each["eval.n_episodes"] for each in found} == {"6"}
        assert [each.get("policy.sampling") for each in found] == [None, None, "true"]


def test_the_preset_is_a_policy_that_sees_one_of_two_views(make_experiment: Callable[..., Any]) -> None:
    config = draccus.parse(TrainPipelineConfig, args=make_experiment().fit()[1:])
    assert isinstance(config.policy, OpenVLAConfig)
    assert (config.steps, config.policy.sizes.patches) == (5, 64)
    assert len(config.dataset.episodes) == 3
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 64, 64))
    config.policy.input_features = {f"observation.images.{view}": image for view in VIEWS}
    config.policy.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
    policy = OpenVLAPolicy(config.policy)
    assert list(policy.config.input_features) == ["observation.images.side_view"]
    assert 3e5 < sum(parameter.numel() for parameter in policy.model.parameters()) < 1.5e6


def test_adapters_of_the_small_model_are_asked_for(make_experiment: Callable[..., Any]) -> None:
    command = [flag for flag in make_experiment().adapt()[1:] if not flag.startswith("--policy.")]
    config = draccus.parse(TrainPipelineConfig, args=command)
    assert (config.peft.method_type, config.peft.r, config.steps, config.save_freq) == ("LORA", 32, 4, 4)
    assert len(config.dataset.episodes) == 2


def test_ppo_samples_from_the_categorical_alone(
    make_experiment: Callable[..., Any], trained_models: dict[str, Path]
) -> None:
    experiment = make_experiment(trained_models["text_world_model"].parent)
    (experiment.gate / "action_world_model").symlink_to(trained_models["action_world_model"])
    command = next(stage.command() for stage in experiment.stages() if stage.name == "imagined_openvla")
    given = [flag for flag in expand_preset(command[1:], "train") if not flag.startswith("--policy.path")]
    config = draccus.parse(TrainConfig, args=given)
    assert config.algorithm.initial_std is None
    assert (config.num_envs, config.rollout_steps, config.iterations, config.seed) == (64, 40, 7, 8)
    assert config.env.done_frames == 2


def test_an_interrupted_training_goes_on(make_experiment: Callable[..., Any], tmp_path: Path) -> None:
    (checkpoint(tmp_path / "out" / "pretrained")).mkdir(parents=True)
    flags = flags_of(make_experiment().fit())
    assert flags["resume"] == "true"
    assert flags["config_path"] == str(checkpoint(tmp_path / "out" / "pretrained") / "train_config.json")


def test_results_are_paired_by_start(make_experiment: Callable[..., Any], tmp_path: Path) -> None:
    """And drawn."""
    before, after = np.array([1, 0, 0, 0]), np.array([1, 1, 1, 0])
    for kind, found in (("cloned", before), ("imagined", after)):
        for domain in MEASURED:
            folder = tmp_path / "out" / f"eval_{kind}_openvla_{domain}"
            folder.mkdir(parents=True)
            tasks = [{"metrics": {"successes": found.tolist()}}]
            (folder / "eval_info.json").write_text(json.dumps({"per_task": tasks}))
    training = tmp_path / "out" / "imagined_openvla"
    training.mkdir()
    (training / "metrics.jsonl").write_text('{"step": 1, "success_rate": 0.5}\n')
    module, experiment = importlib.import_module("openvla_small"), make_experiment()
    results = experiment.results()
    row = results["imagined"]["ood"]["policies"]["openvla"]
    assert (row["cloned"]["k"], row["trained"]["k"], row["gained"], row["lost"]) == (1, 3, 2, 0)
    assert "2 gained, 0 lost" in module.results_table(results)
    module.draw(results, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 1000
