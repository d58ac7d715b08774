"""The depth branch on made-up tokens and depths: what it sees, what it guides, and that it learns."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.decoding import DECODINGS
from lerobot_wmrl.world_models.depth_branch import FAR
from lerobot_wmrl.world_models.frame_network import Prediction
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from tests.trained import small_tokenizer

SIZES: dict[str, Any] = {
    "device": "cpu", "dynamics": "autoregressive",
    "tokenizer": small_tokenizer(cameras=["third_view", "wrist"]),
    "layers": 2, "width": 32, "heads": 2, "window": 4, "code_width": 8, "maskgit_steps": 3,
    "depth": True, "token_noise": 0.0,
}  # fmt: skip
BATCH, TOKENS, CODES, FRAMES = 3, 32, 20, 12
CHANGED = 5


def world_model(**settings: Any) -> ActionWorldModelRewardModel:
    torch.manual_seed(0)
    return ActionWorldModelRewardModel(ActionWorldModelConfig(**SIZES | settings)).eval()


def random_model(**settings: Any) -> ActionWorldModelRewardModel:
    """With random weights everywhere, so that everything matters."""
    model = world_model(**settings)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model


def random_clip() -> Clip:
    torch.manual_seed(1)
    known = torch.ones(BATCH, FRAMES, dtype=torch.bool)
    return Clip(
        torch.randint(0, CODES, (BATCH, FRAMES, TOKENS)), torch.randn(BATCH, FRAMES, 8),
        torch.randn(BATCH, FRAMES, 7), torch.zeros(BATCH, FRAMES), known, known, [""] * BATCH,
        FAR * torch.rand(BATCH, FRAMES, TOKENS),
    )  # fmt: skip


def assert_same(actual: Prediction, expected: Prediction) -> None:
    for one, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=0)


def changed_frames(before: Tensor, after: Tensor) -> list[int]:
    return (before != after).flatten(2).any(-1).any(0).nonzero().flatten().tolist()


@torch.no_grad()
def test_cached_steps_equal_one_long_pass_also_after_the_ring_wraps():
    model, clip = random_model(), random_clip()
    cache = model.network.make_cache(BATCH, clip.tokens.device, torch.float32)
    digits, state = model.network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    depth, (condition, mask) = model.network.depth.normalize(clip.depth, clip.tokens), model.condition(clip)
    steps = []
    for t in range(FRAMES):
        now = slice(t, t + 1)
        steps.append(
            model.network.step(digits[:, now], state[:, now], condition[:, now], mask, cache, depth[:, now])
        )
    stepped = Prediction(*(torch.cat(parts, 1) for parts in zip(*steps, strict=True)))
    assert_same(stepped, model.predict(clip))


@torch.no_grad()
def test_depth_guides_the_tokens_and_nothing_sees_the_future():
    model, clip = random_model(), random_clip()
    before = model.predict(clip)
    clip.depth[:, CHANGED] = FAR * torch.rand(BATCH, TOKENS)
    after = model.predict(clip)
    for name in ("logits", "depth", "done_logit", "proprioception"):
        frames = changed_frames(*(getattr(p, name)[..., None] for p in (before, after)))
        assert frames[:4] == list(range(CHANGED, CHANGED + 4)), name


@torch.no_grad()
def test_the_tokens_do_not_reach_the_depth_but_the_actions_do():
    model, clip = random_model(), random_clip()
    depth = model.predict(clip).depth
    assert torch.equal(model.predict(clip._replace(tokens=clip.tokens.flip(0))).depth, depth)
    clip.action[:, CHANGED] += 1
    assert changed_frames(depth, model.predict(clip).depth)[0] == CHANGED


@torch.no_grad()
def test_it_begins_as_the_model_without_depth():
    plain, model, clip = random_model(depth=False), world_model(), random_clip()
    missing, unexpected = model.load_state_dict(plain.state_dict(), strict=False)
    assert all(name.startswith("network.depth.") for name in missing)
    assert not unexpected
    expected, found = plain.predict(clip), model.predict(clip)
    assert expected.depth.shape == (BATCH, FRAMES, 0)
    assert_same(found._replace(depth=expected.depth), expected)
    metres = model.network.depth.metres(found.depth)
    torch.testing.assert_close(metres, clip.depth)


@pytest.mark.parametrize("decoding", list(DECODINGS))
def test_a_restarted_imagination_is_a_new_one(decoding):
    model, clip = random_model(decoding=decoding), random_clip()
    first, new = ((clip.tokens[:, t], clip.state[:, t], clip.depth[:, t]) for t in (0, 1))

    def start(tokens: Tensor, state: Tensor, depth: Tensor) -> Any:
        return model.start(tokens, state, depth=depth)

    def roll(running: Any, actions: Tensor) -> list[Tensor]:
        steps = [model.step(running, action) for action in actions.unbind(1)]
        return [torch.stack([getattr(step, name) for step in steps], 1) for name in ("tokens", "depth")]

    running = start(*first)
    roll(running, clip.action[:, :6])
    model.restart(running, torch.tensor([True, False, False]), *new)
    after, fresh = roll(running, clip.action[:, 6:]), roll(start(*new), clip.action[:, 6:])
    whole = roll(start(*first), clip.action)
    for one, anew, through in zip(after, fresh, whole, strict=True):
        torch.testing.assert_close(one[0], anew[0], atol=1e-3, rtol=0)
        torch.testing.assert_close(one[1:], through[1:, 6:], atol=1e-3, rtol=0)


def moving_depth_clip() -> Clip:
    """A wall with steps in it comes nearer or goes away, as the action says; the tokens tell nothing."""
    torch.manual_seed(2)
    batch, length = 8, 6
    moves = torch.randint(-1, 2, (batch, length))
    place = 0.1 * torch.cat([torch.zeros(batch, 1), moves[:, :-1].cumsum(1)], 1)
    depth = torch.linspace(0.8, 1.6, 16) + place[..., None]
    known = torch.ones(batch, length, dtype=torch.bool)
    action = torch.zeros(batch, length, 7)
    action[..., 0] = moves
    return Clip(
        torch.full(depth.shape, 3), torch.zeros(batch, length, 0), action, torch.zeros(batch, length), known,
        known, [""] * batch, depth,
    )  # fmt: skip


def test_a_moving_depth_is_learnt_and_imagined():
    """Open loop, much better than depth that stays: the branch heeds actions and its own predictions."""
    model = world_model(
        tokenizer=small_tokenizer(), state_size=0, patch=1, layers=1, self_forcing=0.0
    ).train()
    clip = moving_depth_clip()
    optimizer = torch.optim.Adam(model.network.parameters(), 3e-3)
    for _ in range(120):
        loss, _ = model.loss(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    state = model.eval().start(clip.tokens[:, 0], clip.state[:, 0], depth=clip.depth[:, 0])
    imagined = torch.stack([model.step(state, action).depth for action in clip.action[:, :-1].unbind(1)], 1)
    error, still = ((depth - clip.depth[:, 1:]).abs().mean() for depth in (imagined, clip.depth[:, :1]))
    assert error < still / 4


def test_depth_that_is_missing_or_on_another_grid_is_named():
    model, clip = random_model(), random_clip()
    with pytest.raises(ValueError, match=r"depth: none, .*--model\.depth=true"):
        model.start(clip.tokens[:, 0], clip.state[:, 0])
    with pytest.raises(ValueError, match=r"depth: shape \(3, 12, 8\), .*shape \(3, 12, 32\)"):
        model.loss(clip._replace(depth=clip.depth[..., :8]))


@torch.no_grad()
def test_rollouts_in_training_show_the_depth_that_was_imagined():
    model, clip = random_model(self_rollout=1.0, self_forcing=0.0), random_clip()
    depth = model.network.depth.normalize(clip.depth, clip.tokens)
    digits, state = model.network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    _, _, seen = model.dynamics.inputs(model, clip, model.condition(clip), digits, state, depth)
    imagination = model.start(clip.tokens[:, 0], clip.state[:, 0], depth=clip.depth[:, 0])
    imagined = model.step(imagination, clip.action[:, 0]).depth
    assert torch.equal(seen[:, 0], depth[:, 0])
    torch.testing.assert_close(model.network.depth.metres(seen[:, 1]), imagined, atol=1e-4, rtol=0)
