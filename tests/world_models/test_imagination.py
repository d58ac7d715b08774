"""Imagination with an untrained world model: repeatable, exact where it must be, without talk to the host."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig, TextWorldModelConfig
from lerobot_wmrl.world_models.decoding import DECODINGS
from lerobot_wmrl.world_models.imagination import ImaginationState
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)
from tests.trained import small_tokenizer

SIZES: dict[str, Any] = {
    "device": "cpu", "dynamics": "autoregressive", "tokenizer": small_tokenizer(),
    "layers": 2, "width": 32, "heads": 2, "window": 4, "code_width": 8, "maskgit_steps": 3,
}  # fmt: skip
BATCH, TOKENS, CODES = 3, 16, 20


def world_model(**settings: Any) -> ActionWorldModelRewardModel:
    """With random weights everywhere, so that everything matters."""
    torch.manual_seed(0)
    model = ActionWorldModelRewardModel(ActionWorldModelConfig(**SIZES | settings)).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model


def first_frames() -> tuple[Tensor, Tensor]:
    return torch.randint(0, CODES, (BATCH, TOKENS)), torch.randn(BATCH, 8)


def roll(
    model: ActionWorldModelRewardModel, state: ImaginationState, actions: Tensor, seed: int = 0
) -> Tensor:
    """Tokens imagined under actions (B, T, A). → (B, T, S)"""
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([model.step(state, action, generator).tokens for action in actions.unbind(1)], 1)


@pytest.mark.parametrize("decoding", list(DECODINGS))
def test_the_same_seed_is_the_same_rollout(decoding):
    model = world_model(decoding=decoding, temperature=1.0)
    tokens, state = first_frames()
    actions = torch.randn(BATCH, 6, 7)
    one, again, other = (roll(model, model.start(tokens, state), actions, seed) for seed in (5, 5, 6))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("decoding", list(DECODINGS))
def test_a_restarted_imagination_is_a_new_one(decoding):
    model = world_model(decoding=decoding)
    (tokens, state), (new_tokens, new_state) = first_frames(), first_frames()
    actions = torch.randn(BATCH, 12, 7)
    running = model.start(tokens, state)
    before = roll(model, running, actions[:, :6])
    model.restart(running, torch.tensor([True, False, False]), new_tokens, new_state)
    after = roll(model, running, actions[:, 6:])
    whole = roll(model, model.start(tokens, state), actions)
    assert torch.equal(torch.cat([before, after], 1)[1:], whole[1:])
    assert torch.equal(after[0], roll(model, model.start(new_tokens, new_state), actions[:, 6:])[0])


def test_bfloat16_computes_about_the_same_and_answers_in_float32():
    model = world_model()
    tokens, state = first_frames()
    action = torch.randn(BATCH, 7)
    half = model.start(tokens, state, dtype=torch.bfloat16)
    exact = model.start(tokens, state, dtype=torch.float32)
    assert half.cache.keys.dtype == torch.bfloat16
    rough, fine = model.step(half, action), model.step(exact, action)
    for name in ("done_logit", "proprioception", "hidden", "entropy"):
        value, expected = getattr(rough, name), getattr(fine, name)
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, expected, atol=0.1, rtol=0.05)
    assert (rough.tokens == fine.tokens).float().mean() > 0.9


@pytest.mark.parametrize("decoding", list(DECODINGS))
def test_a_step_never_waits_for_the_device(decoding):
    """One graph from action to imagined frame, the same for every step: what a CUDA graph needs.

    Tracing breaks, and `fullgraph` raises, where Python asks for the value of a tensor. The graph that was
    traced at the first step is the one that runs at all others, since a recompilation raises too.
    """
    model = world_model(decoding=decoding)
    tokens, proprioception = first_frames()
    actions = torch.randn(BATCH, 6, 7)
    expected = roll(model, model.start(tokens, proprioception), actions)
    state = model.start(tokens, proprioception)
    state.cache = model.network.transformer.make_cache(
        BATCH, model.network.transformer_tokens, tokens.device, torch.float32, grows=False
    )

    def imagine(action: Tensor) -> Tensor:
        return model.step(state, action).tokens

    torch.compiler.reset()
    step = torch.compile(imagine, fullgraph=True, backend="eager", dynamic=False)
    with torch._dynamo.config.patch(error_on_recompile=True):
        graphed = torch.stack([step(action) for action in actions.unbind(1)], 1)
    assert torch.equal(graphed, expected)


def test_a_text_model_imagines_with_every_conditioning():
    tokens, proprioception = first_frames()
    for conditioning in ("cross_attention", "adaln", "additive"):
        torch.manual_seed(0)
        model = TextWorldModelRewardModel(TextWorldModelConfig(**SIZES, conditioning=conditioning)).eval()
        for parameter in model.network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
        logits = {
            text: model.step(model.start(tokens, proprioception, [text] * BATCH)).done_logit
            for text in ("push the can", "pull the box")
        }
        assert (logits["push the can"] - logits["pull the box"]).abs().max() > 1e-3
