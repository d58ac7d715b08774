import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs.rewards import RewardModelConfig
from safetensors.torch import load_file

from lerobot_wmrl.rewards.configuration_general import GeneralConfig
from lerobot_wmrl.tracking import read_metrics
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.clips import ClipSampler
from lerobot_wmrl.world_models.episode_table import golden_episodes, read_episodes
from lerobot_wmrl.world_models.frame_cache import cached_frames, cached_tokens
from tests.trained import action_config, run_training, text_config, train_tokenizer

WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"


@pytest.fixture(scope="module")
def sampler(small_dataset, trained_models) -> ClipSampler:
    table = read_episodes(small_dataset)
    model = load_model(trained_models["action_world_model"], "action_world_model")
    tokens = cached_tokens(small_dataset, model.config.camera_keys, model.tokenizer)
    return ClipSampler(table, tokens, np.arange(6), 12, batch_size=8, seed=3, device="cpu")


def test_batches_are_a_function_of_seed_and_step(sampler):
    first, again, other = sampler(5), sampler(5), sampler(6)
    assert torch.equal(first.action, again.action)
    assert not torch.equal(first.action, other.action)


def test_clips_hold_the_rows_of_one_episode_in_order(sampler):
    clip = sampler.clips(np.array([1]), np.array([4]))
    rows = sampler.table.start[1] + 4 + np.arange(12)
    rows = np.minimum(rows, sampler.table.start[1] + sampler.table.length[1] - 1)
    assert np.array_equal(clip.tokens[0], sampler.tokens[rows])
    assert np.array_equal(clip.action[0], sampler.table.action[rows])
    assert clip.valid.sum() == min(12, sampler.table.length[1] - 4)
    assert not clip.done_known.any()
    assert sampler.clips(np.array([1]), np.array([0])).done_known.sum() == min(12, sampler.table.length[1])


def test_cached_frames_are_those_of_the_dataset(small_dataset):
    frames = cached_frames(small_dataset, ["observation.images.third_view"])
    for index in (0, 7, len(frames) - 1):
        image = small_dataset[index]["observation.images.third_view"]
        assert np.array_equal(frames[index, 0], (image.permute(1, 2, 0) * 255).round().byte().numpy())


def test_only_successful_optimal_episodes_are_golden(small_dataset):
    table = read_episodes(small_dataset)
    assert golden_episodes(table).tolist() == [True, True, False] * 2


@pytest.mark.parametrize("build", [action_config, text_config])
def test_training_goes_on_bit_for_bit_after_a_stop(build, small_dataset, trained_models, tmp_path):
    tokenizer, root = trained_models["frame_tokenizer"], Path(small_dataset.root)
    whole = run_training(build(tokenizer), root, tmp_path / "whole", steps=4)
    partial = run_training(build(tokenizer), root, tmp_path / "partial", steps=4)
    for step in ("000003", "000004"):
        assert (partial / "checkpoints" / step).is_dir()
    (partial / "checkpoints" / "000004").rename(tmp_path / "lost")
    (partial / "checkpoints" / ".000004.partial").mkdir()
    run_training(build(tokenizer), root, partial, steps=4)
    expected, resumed = load_file(whole / WEIGHTS), load_file(partial / WEIGHTS)
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)
    assert [line["step"] for line in read_metrics(partial)] == [1, 2, 3, 4]


def test_a_world_model_learns_one_batch_by_heart(sampler, trained_models):
    torch.manual_seed(0)
    model = load_model(trained_models["action_world_model"], "action_world_model").train()
    model.config.self_forcing = model.config.token_noise = 0.0
    clip = sampler.clips(np.arange(6), np.zeros(6, int))
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], 1e-2)
    for _ in range(120):
        loss, metrics = model.loss(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert metrics["token_accuracy"] > 0.95
    predicted = model.eval().predict(clip).done_logit > 0
    known = clip.valid & clip.done_known
    assert torch.equal(predicted[known], clip.done[known] > 0)


@torch.no_grad()
def test_imagination_equals_the_teacher_forced_pass_on_its_own_frames(sampler, trained_models):
    model = load_model(trained_models["action_world_model"], "action_world_model")
    clip = sampler.clips(np.arange(4), np.zeros(4, int))
    state = model.start(clip.tokens[:, 0], clip.state[:, 0])
    steps = [model.step(state, clip.action[:, t]) for t in range(11)]
    frames = torch.stack([clip.tokens[:, 0], *[step.tokens for step in steps]], 1)
    states = torch.stack([clip.state[:, 0], *[step.proprioception for step in steps]], 1)
    prediction = model.predict(clip._replace(tokens=frames, state=states))
    again = model.network.codebook.tokens(model.network.codebook.sample(prediction.logits, 0.0, None))
    assert torch.equal(again[:, :11], frames[:, 1:])
    done = torch.stack([step.done_logit for step in steps], 1)
    torch.testing.assert_close(prediction.done_logit[:, :11], done, atol=1e-4, rtol=1e-4)


def test_checkpoints_are_self_contained_and_in_lerobots_layout(trained_models):
    for name, folder in trained_models.items():
        last = folder / "checkpoints" / "last" / "pretrained_model"
        assert {path.name for path in last.iterdir()} == {
            "config.json", "model.safetensors", "train_config.json",
        }  # fmt: skip
        assert RewardModelConfig.from_pretrained(str(last)).type == name
        assert json.loads((last / "config.json").read_text()).get("tokenizer_path") is None


def test_wrong_input_is_named(small_dataset, trained_models, tmp_path):
    tokenizer, root = trained_models["frame_tokenizer"], Path(small_dataset.root)
    with pytest.raises(ValueError, match="type 'frame_tokenizer', but 'action_world_model' is needed"):
        load_model(tokenizer, "action_world_model")
    with pytest.raises(ValueError, match="no LeRobotDataset there"):
        run_training(action_config(tokenizer), tmp_path / "nothing", tmp_path / "a")
    config = action_config(tokenizer)
    config.tokenizer_path, config.cameras = None, ["top"]
    with pytest.raises(ValueError, match=r"no observation\.images\.top"):
        run_training(config, root, tmp_path / "b")
    config = action_config(tokenizer)
    config.tokenizer_path = None
    with pytest.raises(ValueError, match="image_size=128"):
        run_training(config, root, tmp_path / "c")
    with pytest.raises(ValueError, match="type=general: this command trains frame_tokenizer"):
        run_training(GeneralConfig(device="cpu"), root, tmp_path / "d")
    assert not (tmp_path / "a").exists()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.txt").write_text("precious")
    with pytest.raises(ValueError, match="holds something else"):
        train_tokenizer(root, tmp_path / "foreign")
    assert (tmp_path / "foreign" / "thesis.txt").read_text() == "precious"


def test_a_truncated_checkpoint_is_named(trained_models, tmp_path):
    source = trained_models["frame_tokenizer"] / "checkpoints" / "last" / "pretrained_model"
    for path in source.iterdir():
        content = path.read_bytes()
        (tmp_path / path.name).write_bytes(
            content[: len(content) // 2 if path.suffix == ".safetensors" else None]
        )
    with pytest.raises(ValueError, match="truncated"):
        load_model(tmp_path, "frame_tokenizer")


def test_a_corrupted_episode_file_is_named_and_leaves_nothing(small_dataset, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(small_dataset.root, root)
    video = next(root.rglob("*.mp4"))
    os.truncate(video, video.stat().st_size // 3)
    with pytest.raises(ValueError, match=rf"episode \d+: .*{video.name} cannot be decoded .*record it again"):
        train_tokenizer(root, tmp_path / "run", steps=1)
    assert not list(tmp_path.rglob("frames-*"))


def test_other_settings_do_not_continue_a_run(small_dataset, trained_models, tmp_path):
    root = Path(small_dataset.root)
    folder = train_tokenizer(root, tmp_path / "run", steps=1)
    with pytest.raises(ValueError, match="other settings"):
        train_tokenizer(root, folder, steps=1, batch_size=3)
