"""Clips that show the model's own rollouts, and the real frames as what is to be predicted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.rewards.factory import make_reward_model

from lerobot_wmrl.data.clips import Clip, ClipSampler
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.world_models.losses import (
    SELF_ROLLOUT_FROM,
    next_frame_loss,
    next_frames,
)
from lerobot_wmrl.world_models.world_model import WorldModelRewardModel
from tests.trained import action_config, text_config

CONFIGS = {"action_world_model": action_config, "text_world_model": text_config}


def model_and_clip(name: str, trained_models, dataset, **settings) -> tuple[WorldModelRewardModel, Clip]:
    """Nothing but rollouts replaces what is seen, and that is made up: no model expects it."""
    torch.manual_seed(0)
    config = CONFIGS[name](
        trained_models["frame_tokenizer"], dynamics="autoregressive", token_noise=0.0, self_forcing=0.0,
        **settings,
    )  # fmt: skip
    model = make_reward_model(config)
    for parameter in model.network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    shape = dataset.num_frames, model.tokenizer.tokens_per_frame
    tokens = np.random.default_rng(0).integers(0, 20, shape)
    sampler = ClipSampler(
        read_episodes(dataset), tokens, np.arange(6), 9, 0.75, batch_size=6, seed=3, device="cpu"
    )
    return model, sampler(0)


def seen_by(model: WorldModelRewardModel, clip: Clip) -> tuple[torch.Tensor, torch.Tensor]:
    digits, state = model.network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    depth = model.network.depth.normalize(clip.depth, clip.tokens)
    return model.dynamics.inputs(model, clip, model.condition(clip), digits, state, depth)[:2]


@pytest.mark.parametrize("name", CONFIGS)
@torch.no_grad()
def test_clips_show_what_the_model_imagines_of_them(name, trained_models, small_dataset):
    model, clip = model_and_clip(name, trained_models, small_dataset, self_rollout=1.0)
    instructions = clip.instructions if name == "text_world_model" else None
    imagination = model.start(clip.tokens[:, 0], clip.state[:, 0], instructions)
    frames, states = [clip.tokens[:, 0]], [imagination.proprioception[:, 0].clone()]
    for action in clip.action[:, :-1].unbind(1):
        frames.append(model.step(imagination, None if instructions else action).tokens)
        states.append(imagination.proprioception[:, 0].clone())
    digits, state = seen_by(model, clip)
    assert torch.equal(model.network.codebook.tokens(digits), torch.stack(frames, 1))
    torch.testing.assert_close(state, torch.stack(states, 1), rtol=1e-5, atol=1e-5)
    assert not torch.equal(model.network.codebook.tokens(digits), clip.tokens)


@pytest.mark.parametrize("name", CONFIGS)
@torch.no_grad()
def test_the_real_frames_are_still_what_is_to_be_predicted(name, trained_models, small_dataset):
    model, clip = model_and_clip(name, trained_models, small_dataset, self_rollout=1.0)
    loss, _ = model.loss(clip)
    real, state = model.network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    prediction = model.network(*seen_by(model, clip), *model.condition(clip))
    codebook = model.network.codebook
    frames = next_frames(codebook, real, clip, model.config.motion_weight)
    expected, _ = next_frame_loss(prediction, codebook, frames, state, clip, model.config)
    torch.testing.assert_close(loss, expected)


@torch.no_grad()
def test_a_share_of_the_clips_and_only_late_in_training(trained_models, small_dataset):
    model, clip = model_and_clip("action_world_model", trained_models, small_dataset, self_rollout=0.5)
    real = model.network.codebook.codes(clip.tokens)
    model.training_progress = SELF_ROLLOUT_FROM - 0.01
    assert torch.equal(seen_by(model, clip)[0], real)
    model.training_progress = SELF_ROLLOUT_FROM
    torch.manual_seed(1)
    replaced = (seen_by(model, clip)[0] != real).flatten(1).any(1)
    torch.manual_seed(1)
    assert torch.equal(replaced, torch.rand(6) < 0.5)
    assert 0 < replaced.sum() < 6


@pytest.mark.parametrize("decoding", ["shifted", "maskgit"])
def test_rollouts_draw_no_global_random_number(decoding, trained_models):
    """Processes roll out different numbers of clips, and must go on with the same random numbers."""
    config = action_config(
        trained_models["frame_tokenizer"], dynamics="autoregressive", decoding=decoding, temperature=1.0
    )
    model = make_reward_model(config)
    tokens, state = torch.zeros(2, model.tokenizer.tokens_per_frame, dtype=torch.long), torch.zeros(2, 8)
    condition = model.encode_actions(torch.zeros(2, 3, 7))
    before = torch.get_rng_state()
    first = model.roll_out(tokens, state, condition, 3, torch.float32)
    assert torch.equal(torch.get_rng_state(), before)
    again = model.roll_out(tokens, state, condition, 3, torch.float32)
    assert torch.equal(first[0], again[0])


@pytest.mark.parametrize(("setting", "value"), [("self_rollout", 1.5), ("keypoint_weight", -1.0)])
def test_impossible_settings_are_named(setting, value, trained_models):
    with pytest.raises(ValueError, match=rf"--model.{setting}={value}: must be"):
        action_config(Path(trained_models["frame_tokenizer"]), **{setting: value})
