"""Dyna rounds: a real training of the world model further, by its command, on data recorded elsewhere."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rl import dyna
from lerobot_wmrl.rl.callbacks import Callbacks
from lerobot_wmrl.rl.configuration_callbacks import DynaConfig, NewRollouts
from lerobot_wmrl.rl.dyna import DynaRounds, round_iterations
from tests.commands import run_here

WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"


@pytest.fixture
def env(small_dataset: LeRobotDataset, trained_models: dict[str, Path]) -> Any:
    config = WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(small_dataset.root)),
        reward=GeneralConfig(alpha=1.0),
        done_frames=2,
        episode_length=4,
        device="cpu",
    )
    return config.create_tensor_env(2)


@pytest.fixture
def rounds(env: Any, small_dataset: LeRobotDataset, tmp_path: Path) -> DynaRounds:
    """Two in nine iterations, of which the first is recorded."""
    config = DynaConfig(2, dataset=NewRollouts([str(small_dataset.root)]), steps=4, batch_size=2)
    return DynaRounds(config, env, None, DatasetSource(str(small_dataset.root)), tmp_path, total=9, seed=0)


def test_rounds_are_spread_evenly_between_the_ends() -> None:
    assert round_iterations(1, 40) == [20]
    assert round_iterations(3, 40) == [10, 20, 30]
    assert round_iterations(3, 4) == [1, 2, 3]
    assert round_iterations(0, 40) == []


def test_a_round_refreshes_the_world_model_and_a_killed_one_goes_on(
    rounds: DynaRounds,
    env: Any,
    small_dataset: LeRobotDataset,
    trained_models: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dyna, "run_subcommand", lambda command: run_here(*command))
    folder = tmp_path / "dyna" / "000003"
    before = {name: value.clone() for name, value in env.model.state_dict().items()}
    record = rounds.run(3, tmp_path, folder)
    assert record == {"episodes": 6, "real_steps": small_dataset.meta.total_frames}
    whole = load_file(folder / "action_world_model" / WEIGHTS)
    checkpoints = folder / "action_world_model" / "checkpoints"
    shutil.rmtree(checkpoints / "000004")
    assert rounds.run(3, tmp_path, folder) == record
    assert all(
        torch.equal(value, whole[name])
        for name, value in load_file(folder / "action_world_model" / WEIGHTS).items()
    )

    env.reset(seed=0)
    rounds.apply({3: record})
    after = env.model.state_dict()
    assert all(
        torch.equal(after[name], value) for name, value in before.items() if name.startswith("tokenizer")
    )
    assert any(not torch.equal(after[name], value) for name, value in before.items())
    assert env.reset(seed=0)[0]["observation.images.third_view"].isfinite().all()
    settings = json.loads((checkpoints / "last" / "pretrained_model" / "train_config.json").read_text())
    assert settings["model"]["pretrained_path"].startswith(str(trained_models["action_world_model"]))
    assert settings["dataset"]["more"] == [str(small_dataset.root)]


class CopyingRecorder:
    """In the simulator's place: notes what is asked for, and leaves the same episodes every time."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.asked: list[tuple[str, int, int, float]] = []

    def record(self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float) -> None:
        self.asked.append((checkpoint.name, episodes, seed, exploration))
        shutil.copytree(self.root, folder)


def test_rounds_build_on_one_another(
    rounds: DynaRounds, small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each trains the world model of the one before, and learns from what all have recorded."""
    monkeypatch.setattr(dyna, "run_subcommand", lambda command: run_here(*command))
    recorder: Any = CopyingRecorder(Path(small_dataset.root))
    rounds.recorder, rounds.config.dataset.roots, rounds.config.n_episodes = recorder, None, 5
    for iteration in (3, 6):
        folder = tmp_path / "dyna" / f"{iteration:06d}"
        record = rounds.run(iteration, tmp_path / "checkpoints" / f"{iteration:06d}", folder)
        assert record["episodes"] == 2 * small_dataset.num_episodes
    assert recorder.asked == [
        ("000003", 2, 900_000, 0.0),
        ("000003", 3, 900_002, 0.4),
        ("000006", 2, 900_005, 0.0),
        ("000006", 3, 900_007, 0.4),
    ]
    starts = {
        replace(rounds, seed=seed).start(number, half)
        for seed in (0, 1, 2, 100_000, 200_000)
        for number in (0, 1)
        for half in (0, 1)
    }
    assert len(starts) == 5 * 4
    assert np.diff(sorted(starts)).min() >= 2, "runs with other seeds record other starts"
    last = folder / "action_world_model" / "checkpoints" / "last" / "pretrained_model"
    settings = json.loads((last / "train_config.json").read_text())
    assert settings["model"]["pretrained_path"].startswith(str(tmp_path / "dyna" / "000003"))
    assert settings["dataset"]["more"] == [
        str(tmp_path / "dyna" / at / noise) for at in ("000003", "000006") for noise in ("calm", "noisy")
    ]


def test_a_round_waits_for_what_is_recorded_elsewhere(rounds: DynaRounds, tmp_path: Path) -> None:
    with pytest.raises(
        TrainingStopped, match=r"Dyna round 2 of 2, after iteration 6: record what the policy in"
    ):
        rounds.run(6, tmp_path / "checkpoints" / "000006", tmp_path)


def test_a_resumed_training_imagines_in_the_newest_world_model(
    rounds: DynaRounds, env: Any, trained_models: dict[str, Path], tmp_path: Path
) -> None:
    """Here the newest is a copy of the first."""
    folder = tmp_path / "dyna" / "000003"
    shutil.copytree(trained_models["action_world_model"], folder / "action_world_model", symlinks=True)
    (folder / "record.json").write_text('{"episodes": 6, "real_steps": 90}')
    stale = tmp_path / "dyna" / "000006"
    stale.mkdir()
    (stale / "record.json").write_text("{}")
    first = env.model
    callbacks = Callbacks([rounds], tmp_path, 9, tracker=None)  # type: ignore[arg-type]
    callbacks.resume(5)
    assert env.model is not first
    assert callbacks.real_steps() == {"real_steps/dyna": 90}
    assert not stale.exists(), "of iterations that are repeated nothing is left"
    assert not callbacks.due(3)
    assert callbacks.due(6)
