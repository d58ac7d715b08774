import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from draccus import parse
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import make_reward_model
from safetensors.torch import load_file

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.constants import KINDS, START_KIND
from lerobot_wmrl.common.flags import format_flags
from lerobot_wmrl.common.presets import PRESETS, preset_settings
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.clips import ClipSampler, InTurn
from lerobot_wmrl.data.dataset import ChosenEpisodes, TrainingData, open_dataset
from lerobot_wmrl.data.embodiment import Embodiment, read_embodiment
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames, cached_tokens
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from lerobot_wmrl.world_models import training_data
from lerobot_wmrl.world_models.anchored import dynamics as anchored
from lerobot_wmrl.world_models.autoregressive import dynamics as autoregressive
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.layers import ClipMemory
from lerobot_wmrl.world_models.training import held_out_metrics, optimizer_step
from lerobot_wmrl.world_models.training_data import golden_episodes, make_joint_sampler, make_sampler
from tests.relabelled import UNLABELLED, relabelled
from tests.trained import action_config, run_training, text_config, tokenizer_config, train_tokenizer

WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"


@pytest.fixture(scope="module")
def sampler(small_dataset, trained_models) -> ClipSampler:
    table = read_episodes(small_dataset)
    model = load_model(trained_models["action_world_model"], "action_world_model")
    tokens = cached_tokens(small_dataset, model.config.tokenizer.camera_keys, model.tokenizer)
    return ClipSampler(table, tokens, np.arange(6), 12, 0.75, batch_size=8, seed=3, device="cpu")


@pytest.mark.parametrize(("clip_length", "frames"), [(2, 2), (3, 3), (12, 3)])
def test_clips_begin_late_enough_to_show_the_last_transition(sampler, monkeypatch, clip_length, frames):
    """The last ones have `frames` frames of their episode."""
    monkeypatch.setattr(ClipSampler, "clips", lambda self, episodes, offsets: (episodes, offsets))
    short = replace(sampler, clip_length=clip_length)
    left = [short.table.length[episodes] - offsets for episodes, offsets in map(short, range(200))]
    assert np.concatenate(left).min() == frames


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


def test_training_meets_every_length_of_history(sampler):
    """From one frame on, at the start of episodes and amid them: windows of random length add nothing."""
    memory = ClipMemory(sampler.clip_length, window=24, head_width=8, device=torch.device("cpu"))
    assert memory.mask.sum(1).tolist() == list(range(1, sampler.clip_length + 1))
    for from_start in (0.75, 0.3):
        drawing = replace(sampler, from_start=from_start)
        amid = torch.cat([~drawing(step).done_known[:, 0] for step in range(50)])
        assert 0.75 < amid.float().mean() / (1 - from_start) < 1.2


@pytest.mark.parametrize("preset", PRESETS)
def test_the_flags_of_a_preset_fit_together(preset):
    """Lookup-free codes from `gpu` on; and the network's patches divide the tokenizer's grid."""
    tokenizer, *world_models = (
        parse(
            TrainWorldModelConfig,
            args=[
                *format_flags(preset_settings(preset, "train-world-model", [kind])),
                f"--model.type={kind}",
                "--model.device=cpu",
            ],
        ).model
        for kind in ("frame_tokenizer", "action_world_model", "text_world_model")
    )
    assert tokenizer.tokenizer.quantizer == ("lfq" if preset in ("gpu", "paper") else "fsq")
    grid = make_reward_model(tokenizer).tokenizer.grid
    assert all(grid % config.dynamics.patch == 0 for config in world_models)


def test_only_chosen_episodes_are_learnt_from(small_dataset, trained_models):
    table = read_episodes(small_dataset)
    model = load_model(trained_models["action_world_model"], "action_world_model")
    assert make_sampler(model, table, [1, 3], batch_size=2, seed=0).episodes.tolist() == [1, 3]
    assert make_sampler(model, table, None, batch_size=2, seed=0).episodes.tolist() == list(range(6))


@pytest.mark.parametrize("kind", ["frame_tokenizer", "action_world_model", "text_world_model"])
def test_held_out_episodes_are_not_learnt_from(kind, small_dataset, trained_models, monkeypatch):
    held_out = np.arange(6) % 2 == 0
    monkeypatch.setattr(EpisodeTable, "validation", property(lambda table: held_out))
    table, model = read_episodes(small_dataset), load_model(trained_models[kind], kind)
    for chosen in (None, [1, 2, 3]):
        learnt = make_sampler(model, table, chosen, batch_size=2, seed=0).episodes
        assert len(learnt)
        assert not held_out[learnt].any()


def test_depth_of_held_out_episodes_is_read_before_training(small_dataset, trained_models, monkeypatch):
    """They are measured on when it is over: what cannot be decoded says so now."""
    monkeypatch.setattr(EpisodeTable, "validation", property(lambda table: np.arange(6) == 4))
    table = read_episodes(small_dataset)
    model = load_model(trained_models["action_world_model"], "action_world_model")
    monkeypatch.setattr(type(model.config), "depth", True)
    filled: list[int] = []

    class Depth:
        def fill(self, rows: np.ndarray) -> None:
            filled.extend(rows.tolist())
            raise ValueError("no more is needed")

    monkeypatch.setattr(training_data, "cached_depth", lambda *_: Depth())
    with pytest.raises(ValueError, match="no more is needed"):
        make_sampler(model, table, [3, 4], batch_size=2, seed=0)
    assert filled == table.row_numbers([3, 4]).tolist()


@pytest.mark.parametrize("kind", ["action_world_model", "text_world_model"])
def test_held_out_losses_are_the_same_again(kind, small_dataset, trained_models, monkeypatch):
    """Noise on codes is for training."""
    monkeypatch.setattr(EpisodeTable, "validation", property(lambda table: np.arange(6) % 2 == 0))
    table, model = read_episodes(small_dataset), load_model(trained_models[kind], kind)
    clip = make_sampler(model, table, None, batch_size=2, seed=0)(0)
    corrupted = []

    def corrupt(codes, codebook):
        corrupted.append(model.training)
        return codes

    for dynamics in (anchored, autoregressive):
        monkeypatch.setattr(dynamics, "corrupt_codes", corrupt)
    first = held_out_metrics(model, table, 2)
    torch.rand(1)
    assert held_out_metrics(model, table, 2) == first
    assert held_out_metrics(model, table, 2, chosen=[1, 3]) == {}, "none of these is held out"
    model.train()(clip, 0.0)
    assert corrupted == [True]


def test_every_second_batch_is_of_a_further_dataset(small_dataset, trained_models):
    table, root = read_episodes(small_dataset), str(small_dataset.root)
    model = load_model(trained_models["action_world_model"], "action_world_model")
    alone = make_sampler(model, table, [1, 3], batch_size=2, seed=0)
    data = TrainingData(root, episodes=[1, 3], more=[root, root])
    joint = make_joint_sampler(model, table, data, batch_size=2, seed=0)
    every = make_sampler(model, table, None, batch_size=2, seed=0)
    for step in (0, 2, 4):
        assert torch.equal(joint(step).action, alone(step).action)
    for step in (1, 3, 5):
        assert torch.equal(joint(step).action, every(step).action)
    data = TrainingData(root, episodes=[1, 3])
    assert not isinstance(make_joint_sampler(model, table, data, batch_size=2, seed=0), InTurn)


def test_done_is_left_alone_where_a_dataset_does_not_say_it(small_dataset, trained_models, tmp_path):
    model = load_model(trained_models["action_world_model"], "action_world_model")
    silent = str(relabelled(Path(small_dataset.root), tmp_path / "unlabelled", UNLABELLED))
    for root, more, known in (
        (str(small_dataset.root), [silent], (True, False)),
        (silent, [str(small_dataset.root)], (False, True)),
        (silent, [silent], (False, False)),
    ):
        table = read_episodes(open_dataset(root))
        joint = make_joint_sampler(model, table, TrainingData(root, more=more), batch_size=8, seed=0)
        assert tuple(bool(joint(step).done_known.any()) for step in (0, 1)) == known


def test_further_datasets_have_instructions_that_a_text_world_model_reads(
    small_dataset, trained_models, make_synthetic_dataset, tmp_path
):
    """Else a training would end at its first batch from there, and each time that it is continued."""
    model = load_model(trained_models["text_world_model"], "text_world_model")
    table = read_episodes(small_dataset)
    more = make_synthetic_dataset(tmp_path / "more", instructions=["push", "y" * 600])
    data = TrainingData(str(small_dataset.root), more=[str(more.root)])
    with pytest.raises(ValueError, match=rf"^dataset\.more={more.root}: .*600 characters has 601 tokens"):
        make_joint_sampler(model, table, data, batch_size=2, seed=0)


def test_cached_frames_are_those_of_the_dataset(small_dataset):
    frames = cached_frames(small_dataset, ["observation.images.third_view"], 32)
    for index in (0, 7, len(frames) - 1):
        image = small_dataset[index]["observation.images.third_view"]
        assert np.array_equal(frames[index, 0], (image.permute(1, 2, 0) * 255).round().byte().numpy())


def test_only_successful_optimal_episodes_are_golden(small_dataset):
    table = read_episodes(small_dataset)
    assert golden_episodes(table).tolist() == [True, True, False] * 2
    kinds = table.columns[START_KIND].copy()
    kinds[[0, 1, 3]] = [KINDS.index(kind) for kind in ("policy", "near_miss", "human_like")]
    assert golden_episodes(replace(table, columns={START_KIND: kinds})).tolist() == [
        False,
        False,
        False,
        True,
        True,
        False,
    ]
    assert golden_episodes(replace(table, columns={})).tolist() == [True, True, False] * 2


@pytest.mark.parametrize(
    ("build", "precision"),
    [
        (action_config, "float32"),
        (action_config, "bfloat16"),
        (text_config, "float32"),
        (lambda _: tokenizer_config(), "bfloat16"),
        (
            partial(action_config, dynamics="autoregressive", self_rollout=1.0, keypoint_weight=1.0),
            "bfloat16",
        ),
    ],
)
def test_training_goes_on_bit_for_bit_after_a_stop(build, precision, small_dataset, trained_models, tmp_path):
    """With its samples, optimiser and random numbers; and the checkpoint tells the precision."""
    tokenizer, root = trained_models["frame_tokenizer"], Path(small_dataset.root)
    settings = {"steps": 4, "precision": precision}
    whole = run_training(build(tokenizer), root, tmp_path / "whole", **settings)
    partial = run_training(build(tokenizer), root, tmp_path / "partial", **settings)
    for step in ("000003", "000004"):
        assert (partial / "checkpoints" / step).is_dir()
    (partial / "checkpoints" / "000004").rename(tmp_path / "lost")
    (partial / "checkpoints" / ".000004.partial").mkdir()
    run_training(build(tokenizer), root, partial, **settings)
    expected, resumed = load_file(whole / WEIGHTS), load_file(partial / WEIGHTS)
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)
    assert [line["step"] for line in read_metrics(partial)] == [1, 2, 3, 4]
    states = [folder / "checkpoints" / "last" / "training_state" for folder in (whole, partial)]
    random, again = (torch.load(state / "training_state.pt")["random_states"][0] for state in states)
    assert all(torch.equal(random[name], again[name]) for name in random)
    used = json.loads((partial / WEIGHTS).with_name("train_config.json").read_text())
    assert used["precision"] == precision
    described = [(folder / WEIGHTS).with_name("config.json").read_text() for folder in (whole, partial)]
    assert described[0] == described[1]


def test_a_world_model_learns_one_batch_by_heart(sampler, trained_models):
    torch.manual_seed(0)
    model = load_model(trained_models["action_world_model"], "action_world_model").train()
    clip = sampler.clips(np.arange(6), np.zeros(6, int))
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], 1e-2)
    for _ in range(120):
        loss, metrics = model(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert metrics["token_accuracy"] > 0.95
    predicted = model.eval().predict(clip).done_logit > 0
    known = clip.valid & clip.done_known
    assert torch.equal(predicted[known], clip.done[known] > 0)


@torch.no_grad()
def test_imagination_equals_the_teacher_forced_pass_on_its_own_frames(sampler, trained_models):
    torch.manual_seed(0)
    config = action_config(trained_models["frame_tokenizer"], dynamics="autoregressive")
    model = make_reward_model(config).eval()
    for parameter in model.dynamics.network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    clip = sampler.clips(np.arange(4), np.zeros(4, int))
    state = model.start(clip.first())
    steps = [model.step(state, clip.action[:, t]) for t in range(11)]
    frames = torch.stack([clip.tokens[:, 0], *[step.tokens for step in steps]], 1)
    states = torch.stack([clip.state[:, 0], *[step.state for step in steps]], 1)
    prediction = model.predict(clip._replace(tokens=frames, state=states))
    codebook = model.dynamics.network.codebook
    again = codebook.tokens(codebook.most_likely(prediction.logits))
    assert torch.equal(again[:, :11], frames[:, 1:])
    done = torch.stack([step.done_logit for step in steps], 1)
    torch.testing.assert_close(prediction.done_logit[:, :11], done, atol=1e-4, rtol=1e-4)


def test_checkpoints_are_self_contained_and_in_lerobots_layout(trained_models):
    for name, folder in trained_models.items():
        last = folder / "checkpoints" / "last" / "pretrained_model"
        assert {path.name for path in last.iterdir()} == {
            "config.json",
            "model.safetensors",
            "train_config.json",
        }
        assert RewardModelConfig.from_pretrained(str(last)).type == name
        assert json.loads((last / "config.json").read_text()).get("tokenizer_path") is None


def test_a_world_model_does_without_proprioception(small_dataset, trained_models, tmp_path):
    """Trained, replayed and lived in, all with --model.state_size=0."""
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    action = run_training(action_config(tokenizer, state_size=0), root, tmp_path / "action")
    text = run_training(text_config(tokenizer, state_size=0), root, tmp_path / "text")
    eval_world_model(
        EvalWorldModelConfig(
            model=Checkpoint(str(action)),
            text_model=Checkpoint(str(text)),
            dataset=ChosenEpisodes(str(root)),
            output_dir=tmp_path / "replay",
        )
    )
    assert "tcp_error_mm_by_step" not in json.loads((tmp_path / "replay" / "metrics.json").read_text())
    config = WorldModelEnv(
        world_model_path=str(action), text_world_model_path=str(text), dataset=StartFrames(str(root))
    )
    observation, _ = config.create_tensor_env(2).reset(seed=0)
    assert "observation.state" not in observation


def test_other_settings_do_not_continue_a_run(small_dataset, trained_models, tmp_path):
    root = Path(small_dataset.root)
    folder = train_tokenizer(root, tmp_path / "run", steps=1)
    with pytest.raises(ValueError, match="other settings"):
        train_tokenizer(root, folder, steps=1, batch_size=3)


def test_weights_are_left_as_they_are_where_the_loss_has_no_gradient():
    """The loss of a step is finite and its gradient is not: a step would write NaN into a checkpoint."""
    model = torch.nn.Linear(1, 1, bias=False)
    torch.nn.init.zeros_(model.weight)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    with pytest.raises(ValueError, match=r"gradient's norm is inf; the last checkpoint is kept"):
        optimizer_step(model, model.weight.sqrt().sum(), optimizer, 1.0)
    assert model.weight.item() == 0


def test_the_range_of_the_actions_is_that_of_the_chosen_episodes(small_dataset, trained_models, tmp_path):
    """Others may be left out because theirs is wrong."""
    root = Path(shutil.copytree(small_dataset.root, tmp_path / "data"))
    info = json.loads((root / "meta" / "info.json").read_text())
    del info["features"]["action"]["info"]  # which says the range
    (root / "meta" / "info.json").write_text(json.dumps(info))
    config = TrainWorldModelConfig(
        model=action_config(trained_models["frame_tokenizer"]),
        dataset=TrainingData(str(root), episodes=[0, 3]),
        output_dir=tmp_path / "run",
        steps=1,
        batch_size=2,
        precision="float32",
    )
    train_world_model(config)
    found = load_model(tmp_path / "run", "action_world_model").config.embodiment
    meta = open_dataset(root).meta
    assert found == read_embodiment(meta, Embodiment(), [0, 3])
    assert found != read_embodiment(meta, Embodiment())
