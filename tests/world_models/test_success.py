"""Success classified in frames, and read by a world model from the features that it predicts."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.clips import MOST_WEIGHT, SUCCESS_SHARE, ClipSampler, FrameSampler
from lerobot_wmrl.data.dataset import TrainingData
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.data.frame_cache import cached_features, cached_frames, frames_to_tensor
from lerobot_wmrl.evaluation.outcomes import Outcomes, predict_done, seen_outcomes
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.losses import feature_loss
from lerobot_wmrl.world_models.modeling_frame_tokenizer import FrameTokenizerRewardModel
from lerobot_wmrl.world_models.success import SuccessClassifier, augment
from lerobot_wmrl.world_models.training_data import make_sampler
from tests.relabelled import UNLABELLED, relabelled
from tests.trained import action_config, run_training, text_config, tokenizer_config

CAMERA = "observation.images.third_view"


@pytest.fixture(scope="module")
def models(small_dataset, tmp_path_factory) -> dict[str, Path]:
    """A tokenizer that classifies success and both world models on it, a few steps each."""
    root, folder = Path(small_dataset.root), tmp_path_factory.mktemp("success")
    tokenizer = run_training(tokenizer_config(context=True, success=True), root, folder / "frame_tokenizer")
    text = text_config(tokenizer)
    return {
        "frame_tokenizer": tokenizer,
        "action_world_model": run_training(action_config(tokenizer), root, folder / "action"),
        "text_world_model": run_training(text, root, folder / "text"),
    }


def test_recorded_frames_are_judged_by_the_classifier(models, trained_models, small_dataset, monkeypatch):
    """What a world model that imagines them exactly would say; nothing without a classifier."""
    model, without = (
        load_model(each["action_world_model"], "action_world_model") for each in (models, trained_models)
    )
    recording = Recording.read(read_episodes(small_dataset), model)
    found = seen_outcomes(model, recording, [1, 4])
    start = recording.rows(4).start
    rows = slice(start, start + model.config.clip_length)
    frames = frames_to_tensor(recording.frames[start : rows.stop + 1])  # the last action leads to one more
    with torch.no_grad():
        features = model.tokenizer.success_features(frames[:1].expand_as(frames), frames)
        seen = model.tokenizer.success.head(features).sigmoid().numpy()
    assert found.probability.shape[1] == model.config.clip_length
    assert np.allclose(found.probability[1], seen[1:], atol=1e-5)
    assert found.done[1].tolist() == recording.table.done[rows].tolist()
    assert found.held == Outcomes.stack(predict_done(model, recording)).where(np.isin(range(6), [1, 4])).held
    assert seen_outcomes(without, recording, [1, 4]) is None
    monkeypatch.setattr(EpisodeTable, "has_labels", False)
    assert seen_outcomes(model, recording, [1, 4]) is None


def test_success_counts_as_seen_within_a_clip(models, small_dataset):
    model = load_model(models["action_world_model"], "action_world_model")
    recording = Recording.read(read_episodes(small_dataset), model)
    (late,) = recording.table.success.nonzero()[0][:1]
    model.config.clip_length = int(recording.table.done[recording.rows(late)].argmax())
    found = seen_outcomes(model, recording, [late])
    assert found.probability.shape[1] == model.config.clip_length
    assert not found.success.any()


def pushed_squares(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """A square somewhere, the same some columns further right, and whether it is at least 8 columns.

    Neither frame alone tells. → (B, 1, 3, 32, 32) twice, (B,)
    """
    rng = np.random.default_rng(seed)
    first, frames = torch.zeros(2, count, 1, 3, 32, 32)
    moved = torch.from_numpy(rng.choice([0, 2, 4, 11, 13], count))
    for row in range(count):
        top, left = rng.integers(4, 24), rng.integers(4, 12)
        first[row, :, :, top : top + 4, left : left + 4] = 1
        left += int(moved[row])
        frames[row, :, :, top : top + 4, left : left + 4] = 1
    return first, frames, moved >= 8


def test_the_classifier_learns_success_that_depends_on_the_first_frame():
    torch.manual_seed(0)
    classifier = SuccessClassifier(1)
    optimizer = torch.optim.AdamW(classifier.parameters(), 2e-3)
    for step in range(120):
        loss, _ = classifier.loss(*pushed_squares(32, step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    first, frames, success = pushed_squares(200, 1000)
    with torch.no_grad():
        features = classifier.eval().features(first, frames)
    assert ((classifier.head(features) > 0) == success).float().mean() > 0.95
    assert features.mean().abs() < 0.3
    assert features.std() == pytest.approx(1, abs=0.4)


def test_both_frames_of_a_pair_are_shifted_and_brightened_alike():
    torch.manual_seed(0)
    first, frames, _ = pushed_squares(6, 0)
    one, same = augment(first, first)
    torch.testing.assert_close(one, same)
    assert (one - first).flatten(1).abs().amax(1).min() > 0.01
    before, after = augment(first, frames)
    for old, new, a, b in zip(first, frames, before, after, strict=True):
        moved = bright_column(new) - bright_column(old)
        assert bright_column(b) - bright_column(a) == pytest.approx(moved, abs=0.05)


def bright_column(image: Tensor) -> float:
    """Mean column of the pixels that are brighter than half of the range. (1, 3, H, W)"""
    grey = image.mean((0, 1))
    bright = (grey > (grey.min() + grey.max()) / 2).float()
    return float((bright.sum(0) * torch.arange(bright.shape[1])).sum() / bright.sum())


def test_a_frame_is_labelled_by_the_action_before_it(small_dataset):
    """`next.success` of a row is about the frame after it, and the first frame follows no action."""
    table = read_episodes(small_dataset)
    frames = cached_frames(small_dataset, [CAMERA], 32)
    sampler = FrameSampler(table, frames, np.arange(len(table.start)), ["third_view"], 64, 0, "cpu")
    known: dict[bytes, bool] = {}
    for start, length in zip(table.start, table.length, strict=True):
        for row in range(start, start + length):
            known[frames[row].tobytes()] = bool(row > start and table.done[row - 1])
    batch = sampler(0)
    seen = (255 * batch[CAMERA]).round().byte().permute(0, 2, 3, 1).numpy()
    assert batch["success"].tolist() == [known[image[None].tobytes()] for image in seen]
    assert any(known.values())


def rare(length: int) -> EpisodeTable:
    """Ten episodes of `length` frames; half of them show success in their last frame, and only there."""
    rows, start = 10 * length, np.arange(10) * length
    done = np.zeros(rows, bool)
    done[start[:5] + length - 2] = True
    numbers = np.zeros((rows, 1), np.float32)
    dataset: Any = SimpleNamespace(root="made up", features={"next.success"})
    return EpisodeTable(dataset, numbers, numbers, done, start, np.full(10, length), ["open"] * 10)


def test_batches_of_frames_show_success_in_a_twentieth_at_least():
    table = rare(100)  # of every 200th frame
    frames = np.zeros((len(table.done), 1, 4, 4, 3), np.uint8)
    sampler = FrameSampler(table, frames, np.arange(10), ["third_view"], 400, 0, "cpu")
    drawn = np.mean([sampler(step)["success"].float().mean() for step in range(20)])
    assert drawn == pytest.approx(SUCCESS_SHARE, abs=0.01)
    frames[table.start + 99] = 255
    batch = sampler(20)
    shown = batch[CAMERA].mean((1, 2, 3)) == 1
    assert (shown >= batch["success"]).all()  # the frames themselves, not their labels alone
    assert (batch["reference.third_view"] == 0).all()


def test_frames_that_show_success_often_enough_are_drawn_as_they_are():
    table = rare(10)
    sampler = FrameSampler(
        table, np.zeros((100, 1, 4, 4, 3), np.uint8), np.arange(10), ["third_view"], 400, 0, "cpu"
    )
    assert sampler.extra == 0
    none = FrameSampler(
        table, np.zeros((100, 1, 4, 4, 3), np.uint8), np.arange(5, 10), ["third_view"], 400, 0, "cpu"
    )
    assert none.extra == 0
    assert not none(0)["success"].any()


@pytest.mark.parametrize(("length", "weight"), [(10, 1.0), (100, 199 / 19), (1000, MOST_WEIGHT)])
def test_rare_success_weighs_as_much_as_a_twentieth_in_the_loss_of_done(length: int, weight: float):
    table = rare(length)
    sampler = ClipSampler(
        table, np.zeros((len(table.done), 4), np.int32), np.arange(10), 8, 0.5, 2, seed=0, device="cpu"
    )
    assert sampler(0).done_pos_weight == pytest.approx(weight)


@torch.no_grad()
def test_clips_carry_the_features_of_their_frames(models, small_dataset):
    table = read_episodes(small_dataset)
    model = load_model(models["action_world_model"], "action_world_model")
    frames = cached_frames(small_dataset, [CAMERA], 32)
    clip = make_sampler(model, table, None, batch_size=4, seed=0).clips(np.array([2, 0]), np.array([3, 0]))
    for row, (episode, offset) in enumerate([(2, 3), (0, 0)]):
        start = table.start[episode]
        first, now = (frames_to_tensor(frames[[index]]) for index in (start, start + offset + 1))
        torch.testing.assert_close(clip.features[row, 1], model.tokenizer.success_features(first, now)[0])


@torch.no_grad()
def test_cached_features_are_those_of_the_frames(models, small_dataset):
    tokenizer = load_model(models["frame_tokenizer"], "frame_tokenizer").tokenizer
    found = cached_features(small_dataset, [CAMERA], tokenizer)
    frames, start = cached_frames(small_dataset, [CAMERA], 32), read_episodes(small_dataset).start[1]
    expected = tokenizer.success_features(*(frames_to_tensor(frames[[row]]) for row in (start, start + 2)))
    np.testing.assert_allclose(found[start + 2], expected[0], atol=1e-5)


def test_success_is_read_from_predicted_features_by_the_tokenizers_classifier(models):
    model = load_model(models["action_world_model"], "action_world_model")
    done, classifier = model.dynamics.network.done, model.tokenizer.success
    hidden = torch.randn(3, 5, model.config.dynamics.width)
    torch.testing.assert_close(done(hidden).squeeze(-1), classifier.head(done.features(hidden)))


def test_autoregressive_dynamics_keep_their_own_reading_of_success(models):
    model = load_model(models["text_world_model"], "text_world_model")
    assert model.tokenizer.success is not None
    assert not model.config.predicts_success


def test_success_is_learnt_through_features_alone(models, small_dataset):
    """Outcomes are few, and a loss on them would be learnt by heart."""
    model = load_model(models["action_world_model"], "action_world_model").train()
    clip = make_sampler(model, read_episodes(small_dataset), None, batch_size=4, seed=0)(0)
    gradients = []
    for done in (clip.done, 1 - clip.done):
        torch.manual_seed(0)
        model.zero_grad()
        loss, metrics = model(clip._replace(done=done))
        loss.backward()
        gradients.append(model.dynamics.network.done.features.weight.grad.clone())
    assert torch.equal(*gradients)
    assert gradients[0].abs().sum() > 0
    assert {"feature_loss", "done_loss"} <= metrics.keys()
    assert model.dynamics.network.done.head.linear.weight.grad is None


def test_the_loss_of_features_compares_each_step_with_the_next_frame(models, small_dataset):
    model = load_model(models["action_world_model"], "action_world_model")
    clip: Any = make_sampler(model, read_episodes(small_dataset), None, batch_size=4, seed=0)(0)
    ahead = torch.cat([clip.features[:, 1:], torch.full_like(clip.features[:, :1], 1e3)], 1)
    assert feature_loss(ahead, clip) == 0
    assert feature_loss(clip.features, clip) > 0


def test_lerobots_windows_have_features_too(models, small_dataset):
    model = load_model(models["action_world_model"], "action_world_model")
    window = model.config.clip_length
    images = frames_to_tensor(cached_frames(small_dataset, [CAMERA], 32)[:window])[None, :, 0]
    batch = {
        CAMERA: images,
        "action": torch.zeros(1, window, 7),
        "observation.state": torch.zeros(1, window, 8),
    }
    clip = model.clip_from_batch(batch)
    expected = model.tokenizer.success_features(images[:, :1], images[:, 3:4])
    torch.testing.assert_close(clip.features[:, 3], expected, atol=1e-5, rtol=1e-5)


def test_what_success_needs_is_named():
    with pytest.raises(FieldError, match=r"tokenizer\.success=True.*tokenizer\.context"):
        TokenizerConfig(success=True)
    plain = FrameTokenizerRewardModel(tokenizer_config(context=True)).tokenizer
    with pytest.raises(ValueError, match="no success classifier"):
        plain.success_features(torch.zeros(1, 1, 3, 32, 32), torch.zeros(1, 1, 3, 32, 32))


def test_a_dataset_without_labels_is_refused_also_as_a_further_one(small_dataset, tmp_path):
    """Its successes would be learnt as failures."""
    root = Path(small_dataset.root)
    unlabelled = relabelled(root, tmp_path / "unlabelled", UNLABELLED)
    config = tokenizer_config(context=True, success=True)
    with pytest.raises(FieldError, match=r"tokenizer\.success=True.*unlabelled has neither next\.success"):
        run_training(config, unlabelled, tmp_path / "alone")
    with pytest.raises(FieldError, match=r"tokenizer\.success=True.*unlabelled has neither next\.success"):
        train_world_model(
            TrainWorldModelConfig(
                model=config,
                dataset=TrainingData(str(root), more=[str(unlabelled)]),
                output_dir=tmp_path / "beside",
                steps=1,
                batch_size=2,
                save_freq=1,
                log_freq=1,
            )
        )
