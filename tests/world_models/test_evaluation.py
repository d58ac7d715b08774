import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_wmrl.dataset_source import DatasetSource
from lerobot_wmrl.scripts.eval_world_model import Checkpoint, EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.episode_table import choose_episodes, read_episodes
from lerobot_wmrl.world_models.evaluation import (
    OpenLoop,
    Replay,
    accuracy_by_step,
    first_run,
    replay,
    success_agreement,
)
from lerobot_wmrl.world_models.frame_cache import cached_frames


@pytest.fixture(scope="module")
def model(trained_models):
    return load_model(trained_models["action_world_model"], "action_world_model")


@pytest.fixture
def run(model, small_dataset) -> Replay:
    table = read_episodes(small_dataset)
    return replay(model, table, cached_frames(small_dataset, model.config.camera_keys), np.arange(6))


def perfect(run: Replay, model) -> Replay:
    """The same replay by a model that imagines exactly what happened."""
    steps = run.valid.shape[1]
    frames = [torch.from_numpy(run.real_frames(step + 1).copy()) for step in range(steps)]
    images = torch.stack(frames, 1).permute(0, 1, 2, 5, 3, 4).float() / 255
    tokens = model.tokenizer.encode(images.flatten(0, 1)).unflatten(0, images.shape[:2])
    state = torch.stack([torch.from_numpy(run.table.state[run.rows(step + 1)]) for step in range(steps)], 1)
    run.imagined = OpenLoop(tokens, torch.from_numpy(run.done).float(), state)
    return run


def test_the_first_run_is_of_consecutive_frames():
    fired = np.array([[0, 1, 1, 0, 1], [1, 0, 1, 1, 1], [0, 0, 0, 0, 0]], bool)
    assert first_run(fired, 2).tolist() == [1, 2, -1]
    assert first_run(fired, 1).tolist() == [1, 0, -1]
    assert first_run(fired, 6).tolist() == [-1, -1, -1]


def test_a_perfect_model_agrees_about_every_episode(run, model):
    agreement = success_agreement(perfect(run, model), threshold=0.5, frames=3)
    assert (agreement["real_failures"], agreement["false_successes"]) == (2, 0)
    assert (agreement["real_successes"], agreement["recognised_successes"]) == (4, 4)
    assert agreement["done_delay_frames"] == 0
    assert not any(accuracy_by_step(model, run)["tcp_error_mm_by_step"])


def test_a_credulous_model_is_counted_as_such(run):
    everywhere = torch.ones_like(run.imagined.done_probability)
    run.imagined = run.imagined._replace(done_probability=everywhere)
    agreement = success_agreement(run, threshold=0.5, frames=3)
    assert agreement["false_successes"] == agreement["real_failures"] == 2


def test_frames_past_the_end_of_an_episode_do_not_count(run):
    after = torch.from_numpy(~run.acted).float()
    run.imagined = run.imagined._replace(done_probability=after)
    assert not any(success_agreement(run, threshold=0.5, frames=1)["called_success"])


def test_splits_are_disjoint_and_whole(small_dataset):
    table = read_episodes(small_dataset)
    assert choose_episodes(table, "all", 4).tolist() == [0, 1, 3, 5]
    with pytest.raises(ValueError, match="split='ood'"):
        choose_episodes(table, "ood", 4)
    with pytest.raises(ValueError, match="no episode in its validation split"):
        choose_episodes(table, "validation", 4)


def test_the_command_writes_figures_and_pictures(small_dataset, trained_models, tmp_path):
    config = EvalWorldModelConfig(
        model=Checkpoint(str(trained_models["action_world_model"])),
        text_model=Checkpoint(str(trained_models["text_world_model"])),
        dataset=DatasetSource(str(Path(small_dataset.root))),
        output_dir=tmp_path / "check",
    )
    eval_world_model(config)
    metrics = json.loads((tmp_path / "check" / "metrics.json").read_text())
    assert metrics["real_failures"] + metrics["real_successes"] == 6
    assert len(metrics["psnr_by_step"]) == read_episodes(small_dataset).length.max() - 1
    for name in ("comparison_success.gif", "comparison_failure_strip.png", "goal_frames.png", "accuracy.png"):
        assert (tmp_path / "check" / name).stat().st_size > 0
