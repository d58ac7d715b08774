"""Digests of what imagined episodes follow from."""

import shutil
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import PushtEnv

from lerobot_wmrl.common.checkpoints import model_folder
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.content import content_of
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig


def test_models_datasets_and_files_are_known_by_their_content(
    trained_models: dict[str, Path], small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    for name in ("action_world_model", "text_world_model"):
        shutil.copytree(model_folder(trained_models[name]), tmp_path / name)
    shutil.copytree(small_dataset.root, tmp_path / "data")
    frames = tmp_path / "frames.npz"
    frames.write_bytes(b"first")
    env = WorldModelEnv(
        world_model_path=str(tmp_path / "action_world_model"),
        text_world_model_path=str(tmp_path / "text_world_model"),
        dataset=StartFrames(root=str(tmp_path / "data"), frames=str(frames)),
        reward=GeneralConfig(),
    )
    first = content_of(env)
    assert first.keys() == {"world_model_path", "text_world_model_path", "dataset", "dataset.frames"}
    assert content_of(env) == first
    frames.write_bytes(b"other")
    (tmp_path / "action_world_model" / "model.safetensors").write_bytes(b"other")
    stats = tmp_path / "data" / "meta" / "stats.json"
    stats.write_text(stats.read_text() + "\n")
    changed = content_of(env)
    assert {name for name in first if first[name] != changed[name]} == {
        "world_model_path",
        "dataset",
        "dataset.frames",
    }
    assert content_of(PushtEnv()) == content_of(None) == {}


def test_what_is_not_there_is_named_by_its_setting(trained_models: dict[str, Path], tmp_path: Path) -> None:
    env = WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        text_world_model_path=str(tmp_path / "nothing"),
        reward=GeneralConfig(),
    )
    with pytest.raises(FieldError, match=r"^text_world_model_path=.*nothing: nothing can be read there"):
        content_of(env)
