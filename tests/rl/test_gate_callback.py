"""The gate asks what the evaluation asks, stops or warns, and never passes what nobody has asked about."""

import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import draccus
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import LiberoEnv

from lerobot_wmrl.common.checkpoints import model_folder
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.flags import env_flags, format_flags
from lerobot_wmrl.common.seeds import GATE_SEED
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.evaluation.gate import Gate, gate_at
from lerobot_wmrl.evaluation.outcomes import labelled_recording, predict_outcomes
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rl import recorders
from lerobot_wmrl.rl.configuration_callbacks import GateConfig
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.rl.gate_callback import SuccessGate
from lerobot_wmrl.rl.recorders import ManiSkillRecorder
from lerobot_wmrl.world_models.checkpoint import load_model

BELIEVES_ALL, BELIEVES_NONE = 0.0001, 0.9999
"""Done thresholds."""


@pytest.fixture(scope="module")
def env(small_dataset: LeRobotDataset, trained_models: dict[str, Path]) -> Any:
    config = WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(small_dataset.root)),
        reward=GeneralConfig(alpha=1.0),
        done_threshold=BELIEVES_ALL,
        done_frames=2,
        episode_length=20,
        device="cpu",
    )
    return config.create_tensor_env(2)


@pytest.fixture
def make_gate(env: Any, small_dataset: LeRobotDataset) -> Any:
    def make(threshold: float, labelled: bool = True, **config: Any) -> SuccessGate:
        env.config = replace(env.config, done_threshold=threshold)
        dataset = DatasetSource(str(small_dataset.root) if labelled else "")
        return SuccessGate(GateConfig(dataset=dataset, **config), env, None, frozenset({3}), total=8)

    return make


def test_a_verdict_is_the_evaluations_own(
    make_gate: Any, env: Any, small_dataset: Any, tmp_path: Path
) -> None:
    gate = make_gate(BELIEVES_ALL)
    found = gate.run(0, tmp_path, tmp_path / "gate")
    outcomes = predict_outcomes(env.model, labelled_recording(env.model, read_episodes(small_dataset)))
    assert found["labelled"] == gate_at(outcomes, SuccessCriterion(BELIEVES_ALL, 2)).as_json()
    assert found["labelled"]["false_positive_rate"]["share"] == 1.0
    assert found["failed"]
    assert found["real_steps"] == 0
    strips = {path.name for path in (tmp_path / "gate").glob("*.png")}
    assert strips == {"labelled_success.png", "labelled_failure.png"}


def test_outcomes_are_judged_by_as_many_frames_as_are_imagined(
    make_gate: Any, env: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None of the episodes succeeds within four."""
    gate = make_gate(BELIEVES_ALL)
    monkeypatch.setattr(env, "config", replace(env.config, episode_length=4))
    found = gate.run(0, tmp_path, tmp_path / "gate")["labelled"]
    assert (found["recall"]["n"], found["false_positive_rate"]["n"]) == (0, 6)
    branching = replace(env.config, dataset=replace(env.config.dataset, branches=1))
    monkeypatch.setattr(env, "config", branching)
    found = gate.run(0, tmp_path, tmp_path / "whole")["labelled"]
    assert (found["recall"]["n"], found["false_positive_rate"]["n"]) == (4, 2), "imagined from later frames"


def test_above_the_limit_it_stops_or_warns_with_advice(
    make_gate: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gate = make_gate(BELIEVES_ALL)
    records = {0: gate.run(0, tmp_path, tmp_path / "gate")}
    with pytest.raises(
        TrainingStopped, match=r"failures successes, 100 % \(2 of 2.*near misses.*dyna\.rounds"
    ):
        gate.apply(records)
    warning = make_gate(BELIEVES_ALL, action="warn")
    with caplog.at_level(logging.WARNING):
        warning.apply(records)
    assert "the world model calls failures successes" in caplog.text
    assert "dyna.rounds" in caplog.text
    assert "dyna" not in records[0]["warning"], "what is shown of it elsewhere has its own advice"
    tolerant = make_gate(BELIEVES_ALL, limit=1.0)
    record = tolerant.run(0, tmp_path, tmp_path / "tolerant")
    assert (record["failed"], record["warning"]) == (False, None)


def test_at_the_limit_training_goes_on(
    make_gate: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gate = make_gate(BELIEVES_NONE)
    with caplog.at_level(logging.WARNING):
        record = gate.run(0, tmp_path, tmp_path / "gate")
        assert "The world model has learnt from 6 of these episodes" in caplog.text
        caplog.clear()
        gate.apply({0: record})
    assert record["labelled"]["false_positive_rate"]["k"] == 0
    assert not [entry for entry in caplog.records if entry.levelno >= logging.WARNING]


def test_rollouts_that_a_dyna_round_has_learnt_from_are_warned_about(
    make_gate: Any,
    make_synthetic_dataset: Any,
    env: Any,
    tmp_path: Path,
    trained_models: dict[str, Path],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = str(make_synthetic_dataset(tmp_path / "recorded", episodes=3, length=5).root)
    newer = tmp_path / "newer"
    shutil.copytree(model_folder(trained_models["action_world_model"]), newer)
    write_json(newer / "train_config.json", {"dataset": {"root": "elsewhere", "more": [root]}})
    gate = make_gate(BELIEVES_NONE)
    gate.config.dataset = DatasetSource(root)
    with caplog.at_level(logging.WARNING):
        gate.run(0, tmp_path, tmp_path / "gate")
        assert "has learnt from" not in caplog.text
        monkeypatch.setattr(env, "model", load_model(newer, "action_world_model"))
        gate.run(3, tmp_path, tmp_path / "gate")
    assert f"The world model has learnt from 3 of these episodes ({root})" in caplog.text


def test_what_nobody_has_asked_about_has_not_passed(
    make_gate: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gate = make_gate(BELIEVES_ALL, labelled=False, action="warn")
    record = gate.run(0, tmp_path, tmp_path / "gate")
    assert "passed" not in str(record)
    with caplog.at_level(logging.WARNING):
        gate.apply({0: record})
    assert "nobody has checked how many failures" in caplog.text


def test_it_asks_in_every_new_world_model_and_again_where_it_can_roll_out(make_gate: Any, env: Any) -> None:
    gate = make_gate(BELIEVES_ALL, freq=2)
    assert [iteration for iteration in range(9) if gate.due(iteration)] == [0, 3]
    gate.recorder = ManiSkillRecorder(WmrlManiSkillEnv(), 1, ["third_view"], False)
    assert [iteration for iteration in range(9) if gate.due(iteration)] == [0, 2, 3, 4, 6]


def test_the_recorder_gets_what_is_not_as_by_default() -> None:
    env = WmrlManiSkillEnv(task="pull", scenes=[0, 2], image_size=64, cameras=["wrist"])
    assert env_flags(env) == {
        "env.type": "wmrl_maniskill",
        "env.task": "pull",
        "env.scenes": [0, 2],
        "env.image_size": 64,
        "env.cameras": ["wrist"],
    }


def test_settings_that_are_mappings_are_given_whole() -> None:
    """A flag a key would be one that the environment does not have."""
    cameras = {"agentview_image": "front", "robot0_eye_in_hand_image": "wrist"}
    flags = format_flags(env_flags(LiberoEnv(camera_name_mapping=cameras), "real_env"))
    read = draccus.parse(TrainConfig, args=flags).real_env
    assert isinstance(read, LiberoEnv)
    assert read.camera_name_mapping == cameras


def test_a_recording_in_a_batched_maniskill_has_a_simulation_in_each_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[list[str]] = []
    monkeypatch.setattr(recorders, "run_subcommand", given.append)
    recorder = ManiSkillRecorder(WmrlManiSkillEnv(task="pull", batched=True), 1, ["wrist"], False)
    recorder.record(tmp_path / "checkpoint", 2, 0, tmp_path / "rollouts")
    assert "--env.task=pull" in given[0]
    assert not [flag for flag in given[0] if flag.startswith("--env.batched")]


@pytest.mark.parametrize(("labelled", "fresh", "failed"), [(0, 0, False), (9, 0, True), (0, 9, True)])
def test_either_source_of_rollouts_fails_the_world_model(
    labelled: int,
    fresh: int,
    failed: bool,
    env: Any,
    small_dataset: LeRobotDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Recorder:
        seeds: ClassVar[list[int]] = []

        def record(self, checkpoint: Path, episodes: int, seed: int, folder: Path) -> None:
            self.seeds.append(seed)
            shutil.copytree(small_dataset.root, folder)

    found = iter([labelled, fresh, fresh])

    def verdict(*_: Any) -> Gate:
        return Gate(
            criterion=SuccessCriterion(0.5, 1),
            false_positives=Proportion(next(found), 10),
            recall=Proportion(1, 1),
            cut_short=0,
            repeats_last=False,
            auc=1.0,
        )

    monkeypatch.setattr("lerobot_wmrl.rl.gate_callback.gate_at", verdict)
    config = GateConfig(dataset=DatasetSource(str(small_dataset.root)), n_episodes=5, limit=0.5)
    gate = SuccessGate(config, env, Recorder(), frozenset(), total=8)
    assert gate.run(0, tmp_path, tmp_path / "first")["failed"] == failed
    assert gate.run(4, tmp_path, tmp_path / "later")["failed"] == (fresh > 0)
    assert Recorder.seeds == [GATE_SEED, GATE_SEED + 20]
