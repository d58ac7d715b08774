"""Clips that show the model's own rollouts, and the real frames as what is to be predicted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.rewards.factory import make_reward_model

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.clips import Clip, ClipSampler, known_transitions
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.autoregressive.dynamics import SELF_ROLLOUT_FROM, Inputs
from lerobot_wmrl.world_models.losses import next_frame_loss, weighted_frames
from lerobot_wmrl.world_models.modeling_world_model import WorldModelRewardModel
from tests.trained import action_config, text_config

CONFIGS = {"action_world_model": action_config, "text_world_model": text_config}


def model_and_clip(name: str, trained_models, dataset, **settings) -> tuple[WorldModelRewardModel, Clip]:
    """Nothing but rollouts replaces what is seen, and that is made up: no model expects it."""
    torch.manual_seed(0)
    config = CONFIGS[name](
        trained_models["frame_tokenizer"], dynamics="autoregressive", self_forcing=0.0, **settings
    )
    model = make_reward_model(config)
    for parameter in model.dynamics.network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    shape = dataset.num_frames, model.tokenizer.tokens_per_frame
    tokens = np.random.default_rng(0).integers(0, 20, shape)
    sampler = ClipSampler(
        read_episodes(dataset), tokens, np.arange(6), 9, 0.75, batch_size=6, seed=3, device="cpu"
    )
    return model, sampler(0)


@pytest.fixture(autouse=True)
def no_noise(monkeypatch):
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.0)


def seen_by(model: WorldModelRewardModel, clip: Clip, progress: float = 1.0) -> Inputs:
    codes, state = model.dynamics.network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    real = Inputs(codes, state, torch.zeros(*state.shape[:2], 0))
    return model.dynamics.network_inputs(real, clip._replace(state=state), model.condition(clip), progress)


@pytest.mark.parametrize("name", CONFIGS)
@torch.no_grad()
def test_clips_show_what_the_model_imagines_of_them(name, trained_models, small_dataset):
    model, clip = model_and_clip(name, trained_models, small_dataset, self_rollout=1.0)
    instructions = clip.instructions if name == "text_world_model" else None
    imagination = model.start(clip.first(), instructions)
    frames, states = [clip.tokens[:, 0]], [imagination.state[:, 0].clone()]
    for action in clip.action[:, :-1].unbind(1):
        frames.append(model.step(imagination, None if instructions else action).tokens)
        states.append(imagination.state[:, 0].clone())
    codes, state, _ = seen_by(model, clip)
    tokens = model.dynamics.network.codebook.tokens(codes)
    assert torch.equal(tokens, torch.stack(frames, 1))
    torch.testing.assert_close(state, torch.stack(states, 1), rtol=1e-5, atol=1e-5)
    assert not torch.equal(tokens, clip.tokens)


@pytest.mark.parametrize("name", CONFIGS)
@torch.no_grad()
def test_the_real_frames_are_still_what_is_to_be_predicted(name, trained_models, small_dataset):
    model, clip = model_and_clip(name, trained_models, small_dataset, self_rollout=1.0)
    loss, _ = model(clip)
    network, codebook = model.dynamics.network, model.dynamics.network.codebook
    real, (codes, state, _) = codebook.codes(clip.tokens), seen_by(model, clip)
    prediction, _ = network(codes, state, model.condition(clip))
    target = weighted_frames(codebook, real[:, 1:], real[:, :-1], known_transitions(clip.valid))
    normalized = clip._replace(state=model.normalize_state(clip.state))
    expected, _ = next_frame_loss(prediction, codebook, target, normalized)
    torch.testing.assert_close(loss, expected)


@torch.no_grad()
def test_a_share_of_the_clips_and_only_late_in_training(trained_models, small_dataset):
    model, clip = model_and_clip("action_world_model", trained_models, small_dataset, self_rollout=0.5)
    real = model.dynamics.network.codebook.codes(clip.tokens)
    assert torch.equal(seen_by(model, clip, SELF_ROLLOUT_FROM - 0.01).codes, real)
    torch.manual_seed(1)
    replaced = (seen_by(model, clip, SELF_ROLLOUT_FROM).codes != real).flatten(1).any(1)
    torch.manual_seed(1)
    assert torch.equal(replaced, torch.rand(6) < 0.5)
    assert 0 < replaced.sum() < 6


@pytest.mark.parametrize("passes", [0, 2])
def test_rollouts_draw_no_global_random_number(passes, trained_models):
    config = action_config(trained_models["frame_tokenizer"], dynamics="autoregressive", maskgit_steps=passes)
    model = make_reward_model(config)
    tokens = torch.zeros(2, model.tokenizer.tokens_per_frame, dtype=torch.long)
    first, condition = Frames(tokens, torch.zeros(2, 8)), model.encode_actions(torch.zeros(2, 3, 7))
    before = torch.get_rng_state()
    one = model.dynamics.roll_out(first, condition, 3, torch.float32)
    assert torch.equal(torch.get_rng_state(), before)
    again = model.dynamics.roll_out(first, condition, 3, torch.float32)
    assert torch.equal(one.codes, again.codes)


@pytest.mark.parametrize(
    ("setting", "value", "problem"),
    [("self_rollout", 1.5, "must be between 0 and 1"), ("keypoint_weight", -1.0, "must be at least 0")],
)
def test_impossible_settings_are_named(setting, value, problem, trained_models):
    with pytest.raises(FieldError, match=rf"^dynamics.{setting}={value}: {problem}"):
        action_config(Path(trained_models["frame_tokenizer"]), dynamics="autoregressive", **{setting: value})
