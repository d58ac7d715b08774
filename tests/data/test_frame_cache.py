"""LeRobot's depth maps on the tokens' grid, and a world model trained, replayed and lived in with them."""

import json
import os
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data import frame_cache
from lerobot_wmrl.data.checks import check_cameras
from lerobot_wmrl.data.dataset import ChosenEpisodes, TrainingData, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_depth, depth_of_windows, token_depth, unmeasured_depth
from lerobot_wmrl.data.lazy_rows import LazyRows
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.maniskill.embodiment import FPS
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.autoregressive.depth import metres
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.training_data import make_joint_sampler
from tests.trained import action_config, run_training, text_config

CAMERA = "observation.images.third_view"
SIZE, GRID = 32, 4


@pytest.fixture(scope="module")
def deep_dataset(make_synthetic_dataset, tmp_path_factory) -> LeRobotDataset:
    return make_synthetic_dataset(tmp_path_factory.mktemp("deep") / "dataset", depth=True)


@pytest.fixture(scope="module")
def models(deep_dataset, trained_models, tmp_path_factory) -> dict[str, Path]:
    folder, tokenizer = tmp_path_factory.mktemp("models"), trained_models["frame_tokenizer"]
    configs = {
        "action_world_model": partial(action_config, dynamics="autoregressive"),
        "text_world_model": text_config,
    }
    return {
        name: run_training(config(tokenizer, depth=True), Path(deep_dataset.root), folder / name)
        for name, config in configs.items()
    }


def squares(maps: np.ndarray) -> np.ndarray:
    """Means of (T, H, W) in every token's square, (T, g²)."""
    cut = maps.reshape(len(maps), GRID, SIZE // GRID, GRID, SIZE // GRID)
    return cut.mean((2, 4)).reshape(len(maps), -1)


def test_cached_depth_is_the_mean_of_each_square_in_metres(deep_dataset):
    depth = cached_depth(deep_dataset, [CAMERA], GRID)
    assert depth.shape == (deep_dataset.num_frames, GRID**2)
    rows = [0, 7, len(depth) - 1]
    maps = np.stack([deep_dataset[row][f"{CAMERA}_depth"].numpy()[0] / 1000 for row in rows])
    assert maps.min() < 0.7
    np.testing.assert_allclose(depth[rows], squares(maps), atol=1e-3)


def test_what_was_not_measured_does_not_count():
    maps = torch.full((1, 1, SIZE, SIZE), 2.0)
    maps[..., :4, :8], maps[..., :4, 8:16] = 0.0, torch.nan
    maps[..., 8:16, :8] = 0.0
    depth = token_depth(maps, GRID)[0]
    assert depth.tolist() == [2.0] * 4 + [0.0] + [2.0] * 11


@pytest.mark.parametrize(("dtype", "unit"), [(np.uint16, 1000), (np.float32, 1)])
def test_depth_stored_as_images_is_read_in_its_unit(dtype, unit, tmp_path, monkeypatch):
    """A long episode in parts."""
    monkeypatch.setattr(frame_cache, "DECODED", 2)
    depth_map = {
        "dtype": "image",
        "shape": (SIZE, SIZE, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    }
    dataset = LeRobotDataset.create(
        "local/stored", FPS, {f"{CAMERA}_depth": depth_map}, root=tmp_path / "stored", use_videos=False
    )
    maps = np.random.default_rng(0).uniform(0.5, 2.0, (3, SIZE, SIZE))
    for each in maps:
        dataset.add_frame({f"{CAMERA}_depth": (unit * each).astype(dtype)[..., None], "task": "look"})
    dataset.save_episode()
    dataset.finalize()
    stored = LeRobotDataset("local/stored", root=tmp_path / "stored")
    np.testing.assert_allclose(cached_depth(stored, [CAMERA], GRID), squares(maps), atol=1e-3)
    described = stored.features[f"{CAMERA}_depth"]["info"]
    described["depth_unit"] = {"mm": "m", "m": "mm"}[described["depth_unit"]]  # corrected afterwards
    factor = 1000 if described["depth_unit"] == "m" else 1 / 1000
    found = cached_depth(stored, [CAMERA], GRID)
    np.testing.assert_allclose(found, factor * unit / 1000 * squares(maps) * (1000 / unit), rtol=1e-3)


def test_what_was_not_measured_does_not_count_in_a_batch_of_lerobot_train_either(tmp_path):
    """LeRobot gives such pixels of a video its least depth, 1 cm by default."""
    depth_map = {
        "dtype": "video",
        "shape": (SIZE, SIZE, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    }
    dataset = LeRobotDataset.create(
        "local/holes", FPS, {f"{CAMERA}_depth": depth_map}, root=tmp_path / "holes"
    )
    holes = np.full((SIZE, SIZE, 1), 1000, np.uint16)
    holes[:8, :8] = 0
    holes[8:16, 8:12] = 0
    for _ in range(3):
        dataset.add_frame({f"{CAMERA}_depth": holes, "task": "look"})
    dataset.save_episode()
    dataset.finalize()
    stored = open_dataset(tmp_path / "holes")
    batch = {f"{CAMERA}_depth": torch.stack([stored[row][f"{CAMERA}_depth"] for row in range(3)])[None]}
    assert 0 < batch[f"{CAMERA}_depth"].min() < 11
    depth = depth_of_windows(batch, [CAMERA], GRID, unmeasured_depth(stored.features, [CAMERA]))[0]
    assert (depth[:, 0] == 0).all()
    assert depth[:, 1:].min() > 0.9
    np.testing.assert_allclose(depth, cached_depth(stored, [CAMERA], GRID), atol=1e-3)


def test_cameras_may_have_depth_of_different_sizes():
    batch = {
        "top_depth": torch.full((2, 3, 1, 16, 16), 1000),
        "wrist_depth": torch.full((2, 3, 1, 8, 12), 2000),
    }
    depth = depth_of_windows(batch, ["top", "wrist"], GRID, [0.01, 0.0])
    assert torch.equal(depth, torch.tensor([1.0, 2.0]).repeat_interleave(GRID**2).expand(2, 3, -1))


def test_depth_in_metres_is_refused():
    """lerobot-train gives it so with --dataset.depth_output_unit=m."""
    batch = {"top_depth": torch.full((2, 3, 1, 16, 16), 1.2)}
    with pytest.raises(ValueError, match=r"depth_output_unit=m: no depth of this batch is above 1\.2 mm"):
        depth_of_windows(batch, ["top"], GRID, [0.0])


@pytest.mark.parametrize("name", ["third_view_depth", "../state"])
def test_only_a_camera_of_colours_is_looked_at(name, deep_dataset):
    features = {**deep_dataset.features, "observation.images.../state": deep_dataset.features["action"]}
    meta, key = SimpleNamespace(features=features), f"observation.images.{name}"
    with pytest.raises(ValueError, match=r"has no .* \(its cameras: observation.images.third_view\)"):
        check_cameras(meta, [key], "tokenizer.cameras")


def test_training_reads_depth_and_a_checkpoint_keeps_its_branch(deep_dataset, models):
    for name, folder in models.items():
        assert read_metrics(folder)[0]["depth_error_mm"] > 0
        model = load_model(folder, name)
        assert model.config.depth
        assert model.dynamics.network.depth.fusion[0].weight.abs().sum() > 0, "three steps have moved it"


def test_a_batch_of_lerobot_train_has_the_depth_of_the_cache(deep_dataset, models):
    model = load_model(models["action_world_model"], "action_world_model")
    times = [step / FPS for step in range(-9, 1)]
    windows = LeRobotDataset(
        "local/synthetic",
        root=deep_dataset.root,
        video_backend="pyav",
        delta_timestamps={
            CAMERA: times,
            f"{CAMERA}_depth": times,
            "observation.state": times,
            "action": times,
        },
    )
    batch: dict[str, Any] = torch.utils.data.default_collate([windows[4], windows[9]])
    clip = model.clip_from_batch(batch)
    depth = cached_depth(deep_dataset, [CAMERA], model.tokenizer.grid)
    np.testing.assert_allclose(clip.depth[0, :5], depth[:5], atol=1e-3)
    np.testing.assert_allclose(clip.depth[1], depth[:10], atol=1e-3)
    assert torch.isfinite(model(batch)[0])
    del batch[f"{CAMERA}_depth"]
    with pytest.raises(ValueError, match=r"^depth=True: the batch lacks .*third_view_depth"):
        model.clip_from_batch(batch)


def test_depth_beyond_the_farthest_is_named_and_compared_as_it_is_learnt(
    deep_dataset, models, monkeypatch, caplog, tmp_path
):
    model = load_model(models["action_world_model"], "action_world_model")
    table = read_episodes(deep_dataset)
    make_joint_sampler(model, table, TrainingData(str(deep_dataset.root)), batch_size=2, seed=0)
    assert "of the depth is beyond" not in caplog.text
    far = np.array(cached_depth(deep_dataset, [CAMERA], model.tokenizer.grid))
    far[:, 3] = 4.0
    depth = LazyRows(tmp_path / "far", far.shape, np.float32, table.start, lambda rows: far[rows], 9, "")
    for module in ("training_data", "imagination"):
        monkeypatch.setattr(f"lerobot_wmrl.world_models.{module}.cached_depth", lambda *_: depth)
    make_joint_sampler(model, table, TrainingData(str(deep_dataset.root)), batch_size=2, seed=0)
    assert "6 % of the depth is beyond 2.5 m" in caplog.text
    recorded = model.recorded_depth(deep_dataset, [0, 7])
    assert (recorded[:, 3] == 2.5).all()
    assert (recorded[:, :3] < 1.1).all()


def test_replays_measure_depth_on_the_tokens_grid(deep_dataset, models, tmp_path):
    eval_world_model(
        EvalWorldModelConfig(
            model=Checkpoint(str(models["action_world_model"])),
            text_model=Checkpoint(str(models["text_world_model"])),
            dataset=ChosenEpisodes(str(Path(deep_dataset.root))),
            output_dir=tmp_path / "replay",
        )
    )
    metrics = json.loads((tmp_path / "replay" / "metrics.json").read_text())
    assert 0 < metrics["headline"]["abs_rel"]["value"] < 0.2
    assert metrics["headline"]["delta_2"]["value"] > 0.9
    assert len(metrics["abs_rel_by_step"]) == len(metrics["psnr_by_step"])


def test_the_environment_begins_with_the_depth_of_its_starts(deep_dataset, models, small_dataset):
    def config(dataset: LeRobotDataset) -> WorldModelEnv:
        return WorldModelEnv(
            world_model_path=str(models["action_world_model"]),
            text_world_model_path=str(models["text_world_model"]),
            dataset=StartFrames(root=str(Path(dataset.root))),
            episode_length=3,
            done_threshold=0.999,
        )

    env = config(deep_dataset).create_tensor_env(2)
    env.reset(seed=[1, 4])
    first = cached_depth(deep_dataset, [CAMERA], env.model.tokenizer.grid)
    starts = np.asarray(deep_dataset.meta.episodes["dataset_from_index"])

    def begun() -> np.ndarray:
        return metres(env._imagination.depth[:, 0]).numpy()

    np.testing.assert_allclose(begun(), first[starts[[1, 4]]], atol=1e-4)
    for _ in range(3):
        _, _, _, truncated, _ = env.step(torch.full((2, 7), 0.01))
    assert truncated.all()
    np.testing.assert_allclose(begun(), first[starts[env._start_index.numpy()]], atol=1e-4)
    with pytest.raises(ValueError, match=r"third_view_depth, which the dataset lacks; record it with"):
        config(small_dataset).create_tensor_env(2)


def test_a_dataset_without_depth_is_named_before_anything_is_trained(small_dataset, trained_models, tmp_path):
    with pytest.raises(FieldError, match=r"^depth=True: .*third_view_depth, .*--depth=true"):
        run_training(
            action_config(trained_models["frame_tokenizer"], dynamics="autoregressive", depth=True),
            Path(small_dataset.root),
            tmp_path / "out",
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("linked", ["videos", "videos/observation.images.third_view"])
def test_a_new_recording_behind_a_link_has_a_cache_of_its_own(linked, small_dataset, tmp_path):
    shutil.copytree(small_dataset.root, tmp_path / "data")
    (tmp_path / "data" / linked).rename(tmp_path / "elsewhere")
    (tmp_path / "data" / linked).symlink_to(tmp_path / "elsewhere")
    dataset = open_dataset(tmp_path / "data")
    before = frame_cache.file_stamps(dataset)
    assert before == frame_cache.file_stamps(dataset)
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "elsewhere")
    assert before == frame_cache.file_stamps(dataset)
    os.utime(next((tmp_path / "elsewhere").rglob("*.mp4")), (0, 0))
    assert before != (touched := frame_cache.file_stamps(dataset))
    dataset.meta.info.fps += 1
    assert touched != frame_cache.file_stamps(dataset), "frames are found in videos by it"
