"""What is said about a tokenizer: PSNR per camera, of what moves, and use of its codes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.data.lazy_rows import LazyRows
from lerobot_wmrl.evaluation import reconstruction
from lerobot_wmrl.evaluation.image_metrics import psnr_from_mse
from lerobot_wmrl.evaluation.reconstruction import code_use, reconstruction_metrics, write_reconstruction
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.codebook import BinaryCodeBook, CodeBook
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig, TokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import MOTION_THRESHOLD
from tests.trained import run_training

CAMERAS = ("third_view", "wrist")


@pytest.fixture(scope="module")
def dataset(make_synthetic_dataset, tmp_path_factory):
    """Twenty-one episodes, the twentieth held out, two cameras."""
    root = tmp_path_factory.mktemp("two_cameras") / "dataset"
    return make_synthetic_dataset(root, episodes=21, length=6, cameras=CAMERAS)


@pytest.fixture(scope="module")
def output_dir(dataset, tmp_path_factory) -> Path:
    config = FrameTokenizerConfig(
        tokenizer=TokenizerConfig(list(CAMERAS), 32, [8, 16], levels=[5, 4]), device="cpu"
    )
    return run_training(config, Path(dataset.root), tmp_path_factory.mktemp("runs") / "tokenizer")


@torch.no_grad()
def test_psnr_is_that_of_each_camera_and_of_its_moved_pixels(dataset, output_dir, tmp_path):
    model, table = load_model(output_dir, "frame_tokenizer"), read_episodes(dataset)
    frames = np.array(cached_frames(dataset, model.config.tokenizer.camera_keys, 32))
    frames[:, 1] = frames[table.start[4], 1]
    still = LazyRows(
        tmp_path / "rows", frames.shape, np.uint8, table.start, lambda rows: frames[rows], 64, ""
    )
    metrics = reconstruction_metrics(model, table, still, np.array([4]))
    rows = slice(table.start[4], table.start[4] + table.length[4])
    real = frames_to_tensor(frames[rows])
    error = (model.tokenizer.decode(model.tokenizer.encode(real)) - real) ** 2
    expected = psnr_from_mse(error.mean((2, 3, 4))).mean(0).tolist()
    assert list(metrics["psnr"].values()) == pytest.approx(expected, abs=1e-2)
    moved = (real - real[:1])[:, 0].abs().amax(1) > MOTION_THRESHOLD
    moving = psnr_from_mse(error[:, 0].permute(0, 2, 3, 1)[moved].mean()).item()
    assert metrics["moving_psnr"] == {"third_view": pytest.approx(moving, abs=1e-2), "wrist": None}
    assert metrics["frames"] == table.length[4]


def test_frames_are_thinned_evenly(dataset, output_dir, monkeypatch):
    monkeypatch.setattr(reconstruction, "MAX_FRAMES", 10)
    model, table = load_model(output_dir, "frame_tokenizer"), read_episodes(dataset)
    frames = cached_frames(dataset, model.config.tokenizer.camera_keys, 32)
    assert reconstruction_metrics(model, table, frames, np.arange(21))["frames"] == 10


def test_the_training_of_a_tokenizer_ends_with_the_held_out_episodes(dataset, output_dir):
    report = json.loads((output_dir / "reconstruction.json").read_text())
    assert report["split"] == "validation"
    assert report["frames"] == read_episodes(dataset).length[19]
    assert report["psnr"].keys() == set(CAMERAS)
    assert report["codes"]["size"] == 20
    assert [factor["size"] for factor in report["code_factors"]] == [5, 4]


@pytest.mark.parametrize(
    ("chosen", "split", "measured"),
    [
        ([0, 2], "all", [0, 2]),
        ([0, 19], "validation", [19]),
    ],
)
def test_episodes_that_were_not_chosen_do_not_count(dataset, output_dir, tmp_path, chosen, split, measured):
    model, table = load_model(output_dir, "frame_tokenizer"), read_episodes(dataset)
    report = write_reconstruction(model, table, tmp_path, chosen)
    assert (report["split"], report["frames"]) == (split, table.length[measured].sum())


def test_where_no_episode_is_held_out_it_says_so(trained_models):
    report = json.loads((trained_models["frame_tokenizer"] / "reconstruction.json").read_text())
    assert report["split"] == "all"


def test_code_use_counts_codes_and_their_evenness():
    use = code_use(CodeBook((4, 3)), torch.tensor([[0, 1, 2, 3], [0, 1, 2, 3]]))
    assert use["codes"] == {"size": 12, "used": pytest.approx(1 / 3), "perplexity": 4.0}
    assert use["code_factors"][0] == {"size": 4, "used": 1.0, "perplexity": 4.0}
    assert use["code_factors"][1] == {"size": 3, "used": pytest.approx(1 / 3), "perplexity": 1.0}
    uneven = code_use(BinaryCodeBook((2, 2)), torch.tensor([0, 0, 0, 1]))["codes"]["perplexity"]
    assert uneven == pytest.approx(np.exp(-0.75 * np.log(0.75) - 0.25 * np.log(0.25)), abs=0.01)
