"""The depth branch on made-up tokens and depths: what it sees, what it guides, and that it learns."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.autoregressive.depth import FAR, depth_loss, metres, normalize_depth
from lerobot_wmrl.world_models.autoregressive.dynamics import Inputs
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from tests.trained import nested, small_tokenizer

SIZES: dict[str, Any] = {
    "device": "cpu",
    "dynamics": "autoregressive",
    "tokenizer": small_tokenizer(cameras=["third_view", "wrist"]),
    "layers": 2,
    "width": 32,
    "heads": 2,
    "window": 4,
    "code_width": 8,
    "depth": True,
}
BATCH, TOKENS, CODES, FRAMES = 3, 32, 20, 12
CHANGED = 5


def world_model(**settings: Any) -> ActionWorldModelRewardModel:
    torch.manual_seed(0)
    return ActionWorldModelRewardModel(ActionWorldModelConfig(**nested(SIZES | settings))).eval()


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
        torch.randint(0, CODES, (BATCH, FRAMES, TOKENS)),
        torch.randn(BATCH, FRAMES, 8),
        torch.randn(BATCH, FRAMES, 7),
        torch.zeros(BATCH, FRAMES),
        known,
        known,
        [""] * BATCH,
        FAR * torch.rand(BATCH, FRAMES, TOKENS),
    )


@pytest.fixture(autouse=True)
def no_noise(monkeypatch):
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.0)


def predict(model: ActionWorldModelRewardModel, clip: Clip) -> dict[str, Tensor]:
    """What is predicted from the real frames, by name, and the next depth, normalised."""
    codes, depth = model.dynamics.network.codebook.codes(clip.tokens), None
    if model.config.depth:
        depth = normalize_depth(clip.depth, clip.tokens)
    state, condition = model.normalize_state(clip.state), model.condition(clip)
    prediction, next_depth = model.dynamics.network(codes, state, condition, depth=depth)
    return {**prediction._asdict(), "depth": next_depth}


def assert_same(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert actual.keys() == expected.keys()
    for name, value in actual.items():
        torch.testing.assert_close(value, expected[name], atol=1e-4, rtol=0)


def changed_frames(before: Tensor, after: Tensor) -> list[int]:
    return (before != after).flatten(2).any(-1).any(0).nonzero().flatten().tolist()


@torch.no_grad()
def test_cached_steps_equal_one_long_pass_also_after_the_ring_wraps():
    model, clip = random_model(), random_clip()
    network = model.dynamics.network
    cache = network.make_cache(BATCH, clip.tokens.device, torch.float32)
    codes, state = network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    depth, condition = normalize_depth(clip.depth, clip.tokens), model.condition(clip)
    steps = []
    for t in range(FRAMES):
        now = slice(t, t + 1)
        action = Condition(condition.tokens[:, now])
        prediction, next_depth = network(codes[:, now], state[:, now], action, cache.advance(), depth[:, now])
        steps.append({**prediction._asdict(), "depth": next_depth})
    stepped = {name: torch.cat([step[name] for step in steps], 1) for name in steps[0]}
    assert_same(stepped, predict(model, clip))


@torch.no_grad()
def test_depth_guides_the_tokens_and_nothing_sees_the_future():
    model, clip = random_model(), random_clip()
    before = predict(model, clip)
    clip.depth[:, CHANGED] = FAR * torch.rand(BATCH, TOKENS)
    after = predict(model, clip)
    for name in ("logits", "depth", "done_logit", "state"):
        frames = changed_frames(*(p[name][..., None] for p in (before, after)))
        assert frames[:4] == list(range(CHANGED, CHANGED + 4)), name


@torch.no_grad()
def test_the_tokens_do_not_reach_the_depth_but_the_actions_do():
    model, clip = random_model(), random_clip()
    depth = predict(model, clip)["depth"]
    assert torch.equal(predict(model, clip._replace(tokens=clip.tokens.flip(0)))["depth"], depth)
    clip.action[:, CHANGED] += 1
    assert changed_frames(depth, predict(model, clip)["depth"])[0] == CHANGED


@torch.no_grad()
def test_it_begins_as_the_model_without_depth():
    plain, model, clip = random_model(depth=False), world_model(), random_clip()
    missing, unexpected = model.load_state_dict(plain.state_dict(), strict=False)
    assert all(name.startswith("dynamics.network.depth.") for name in missing)
    assert not unexpected
    expected, found = predict(plain, clip), predict(model, clip)
    assert expected["depth"].shape == (BATCH, FRAMES, 0)
    torch.testing.assert_close(metres(found["depth"]), clip.depth)
    assert_same(found | {"depth": expected["depth"]}, expected)


@pytest.mark.parametrize("passes", [0, 3])
def test_a_restarted_imagination_is_a_new_one(passes):
    model, clip = random_model(maskgit_steps=passes), random_clip()
    first, new = (Frames(clip.tokens[:, t], clip.state[:, t], depth=clip.depth[:, t]) for t in (0, 1))

    def roll(running: Any, actions: Tensor) -> list[Tensor]:
        steps = [model.step(running, action) for action in actions.unbind(1)]
        return [torch.stack([getattr(step, name) for step in steps], 1) for name in ("tokens", "depth")]

    running = model.start(first)
    roll(running, clip.action[:, :6])
    model.restart(running, torch.tensor([True, False, False]), new)
    after, fresh = roll(running, clip.action[:, 6:]), roll(model.start(new), clip.action[:, 6:])
    whole = roll(model.start(first), clip.action)
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
        torch.full(depth.shape, 3),
        torch.zeros(batch, length, 0),
        action,
        torch.zeros(batch, length),
        known,
        known,
        [""] * batch,
        depth,
    )


def test_a_moving_depth_is_learnt_and_imagined():
    """Open loop, much better than depth that stays: the branch heeds actions and its own predictions."""
    model = world_model(
        tokenizer=small_tokenizer(), state_size=0, patch=1, layers=1, self_forcing=0.0
    ).train()
    clip = moving_depth_clip()
    optimizer = torch.optim.Adam(model.dynamics.network.parameters(), 3e-3)
    for _ in range(120):
        loss, _ = model(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    state = model.eval().start(clip.first())
    imagined = torch.stack([model.step(state, action).depth for action in clip.action[:, :-1].unbind(1)], 1)
    error, still = ((depth - clip.depth[:, 1:]).abs().mean() for depth in (imagined, clip.depth[:, :1]))
    assert error < still / 4


def test_what_was_not_measured_is_not_learnt():
    depth = torch.full((1, 3, 2), 0.5)
    depth[0, 1, 0] = -1.0  # 0 m
    predicted = torch.full_like(depth, 0.25)
    error, _ = depth_loss(predicted, depth, torch.ones(1, 3, dtype=torch.bool))
    assert error == 0.25


def test_depth_that_is_missing_or_on_another_grid_is_named():
    model, clip = random_model(), random_clip()
    with pytest.raises(ValueError, match=r"depth: none, .*`dynamics\.depth`"):
        model.start(replace(clip.first(), depth=None))
    with pytest.raises(ValueError, match=r"depth: shape \(3, 12, 8\), .*shape \(3, 12, 32\)"):
        model(clip._replace(depth=clip.depth[..., :8]))


@torch.no_grad()
def test_rollouts_in_training_show_the_depth_that_was_imagined():
    model, clip = random_model(self_rollout=1.0, self_forcing=0.0), random_clip()
    depth = normalize_depth(clip.depth, clip.tokens)
    codes, state = model.dynamics.network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
    real, normalized = Inputs(codes, state, depth), clip._replace(state=state)
    seen = model.dynamics.network_inputs(real, normalized, model.condition(clip), 1.0).depth
    imagination = model.start(clip.first())
    imagined = model.step(imagination, clip.action[:, 0]).depth
    assert torch.equal(seen[:, 0], depth[:, 0])
    torch.testing.assert_close(metres(seen[:, 1]), imagined, atol=1e-4, rtol=0)
