"""Imagination with an untrained world model: repeatable, exact where it must be, without talk to the host."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig, TextWorldModelConfig
from lerobot_wmrl.world_models.dynamics import Imagination
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)
from tests.trained import nested, small_tokenizer

SIZES: dict[str, Any] = {
    "device": "cpu",
    "dynamics": "autoregressive",
    "tokenizer": small_tokenizer(),
    "layers": 2,
    "width": 32,
    "heads": 2,
    "window": 4,
    "code_width": 8,
}
BATCH, TOKENS, CODES = 3, 16, 20


def world_model(**settings: Any) -> ActionWorldModelRewardModel:
    """With random weights everywhere, so that everything matters."""
    torch.manual_seed(0)
    model = ActionWorldModelRewardModel(ActionWorldModelConfig(**nested(SIZES | settings))).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model


def first_frames() -> Frames:
    return Frames(torch.randint(0, CODES, (BATCH, TOKENS)), torch.randn(BATCH, 8))


def roll(model: ActionWorldModelRewardModel, imagination: Imagination, actions: Tensor) -> Tensor:
    """Tokens imagined under actions (B, T, A). → (B, T, S)"""
    return torch.stack([model.step(imagination, action).tokens for action in actions.unbind(1)], 1)


@pytest.mark.parametrize("passes", [0, 3])
def test_imagination_draws_no_random_number(passes):
    model, frames, actions = world_model(maskgit_steps=passes), first_frames(), torch.randn(BATCH, 6, 7)
    before = torch.get_rng_state()
    one, again = (roll(model, model.start(frames), actions) for _ in range(2))
    assert torch.equal(one, again)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("passes", [0, 3])
def test_a_restarted_imagination_is_a_new_one(passes):
    model = world_model(maskgit_steps=passes)
    first, new = first_frames(), first_frames()
    actions = torch.randn(BATCH, 12, 7)
    running = model.start(first)
    before = roll(model, running, actions[:, :6])
    model.restart(running, torch.tensor([True, False, False]), new)
    after = roll(model, running, actions[:, 6:])
    whole = roll(model, model.start(first), actions)
    assert torch.equal(torch.cat([before, after], 1)[1:], whole[1:])
    assert torch.equal(after[0], roll(model, model.start(new), actions[:, 6:])[0])


def test_bfloat16_computes_about_the_same_and_answers_in_float32():
    model = world_model()
    frames = first_frames()
    action = torch.randn(BATCH, 7)
    half = model.start(frames, dtype=torch.bfloat16)
    exact = model.start(frames, dtype=torch.float32)
    assert half.cache.keys.dtype == torch.bfloat16
    rough, fine = model.step(half, action), model.step(exact, action)
    for name in ("done_logit", "state", "hidden", "entropy"):
        value, expected = getattr(rough, name), getattr(fine, name)
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, expected, atol=0.1, rtol=0.05)
    assert (rough.tokens == fine.tokens).float().mean() > 0.9


@pytest.mark.parametrize("passes", [0, 3])
def test_a_step_never_waits_for_the_device(passes):
    """One graph from action to imagined frame, the same for every step: what a CUDA graph needs.

    Tracing breaks, and `fullgraph` raises, where Python asks for the value of a tensor. The graph that was
    traced at the first step is the one that runs at all others, since a recompilation raises too.
    """
    model, frames = world_model(maskgit_steps=passes), first_frames()
    actions = torch.randn(BATCH, 6, 7)
    expected = roll(model, model.start(frames), actions)
    state = model.start(frames)
    state.cache = model.dynamics.network.make_cache(BATCH, frames.tokens.device, torch.float32, grows=False)

    def imagine(action: Tensor) -> Tensor:
        return model.step(state, action).tokens

    torch.compiler.reset()
    step = torch.compile(imagine, fullgraph=True, backend="eager", dynamic=False)
    with torch._dynamo.config.patch(error_on_recompile=True):
        graphed = torch.stack([step(action) for action in actions.unbind(1)], 1)
    assert torch.equal(graphed, expected)


def test_a_text_model_imagines_with_every_conditioning():
    frames = first_frames()
    for conditioning in ("cross_attention", "adaln", "additive"):
        torch.manual_seed(0)
        model = TextWorldModelRewardModel(
            TextWorldModelConfig(**nested(SIZES | {"conditioning": conditioning}))
        ).eval()
        for parameter in model.dynamics.network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
        logits = {
            text: model.step(model.start(frames, [text] * BATCH)).done_logit
            for text in ("push the can", "pull the box")
        }
        assert (logits["push the can"] - logits["pull the box"]).abs().max() > 1e-3
