"""Dynamics that never look at an imagined frame: exact in steps, causal, and learnt from few drawn frames."""

from typing import Any

import pytest
import torch
from draccus import parse
from draccus.utils import DecodingError
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.clips import Clip, known_transitions, take_steps
from lerobot_wmrl.data.embodiment import Embodiment
from lerobot_wmrl.data.frames import NO_CONTEXT, Context, Frames
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.anchored import dynamics as anchored_dynamics
from lerobot_wmrl.world_models.anchored.dynamics import sample_steps
from lerobot_wmrl.world_models.anchored.network import Dropout
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.configuration_world_model import (
    ActionWorldModelConfig,
    AnchoredConfig,
    TextWorldModelConfig,
)
from lerobot_wmrl.world_models.dynamics import Imagined
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)
from lerobot_wmrl.world_models.scaling import STATE_MIN_STD
from tests.trained import nested, small_tokenizer

BATCH, LENGTH, TOKENS, CODES = 3, 6, 32, 20
CAMERAS = ["third_view", "wrist"]
SIZES: dict[str, Any] = {
    "device": "cpu",
    "tokenizer": small_tokenizer(cameras=CAMERAS, context=True),
    "layers": 2,
    "width": 32,
    "heads": 2,
    "code_width": 8,
    "clip_length": LENGTH,
}


def world_model(**settings: Any) -> ActionWorldModelRewardModel:
    """With random weights everywhere, so that everything matters."""
    torch.manual_seed(0)
    model = ActionWorldModelRewardModel(ActionWorldModelConfig(**nested(SIZES | settings))).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model


def random_clip(seed: int = 0, length: int = LENGTH) -> Clip:
    torch.manual_seed(seed)
    yes = torch.ones(BATCH, length, dtype=torch.bool)
    tokens, state = torch.randint(0, CODES, (BATCH, length, TOKENS)), torch.randn(BATCH, length, 8)
    return Clip(
        tokens,
        state,
        torch.randn(BATCH, length, 7),
        torch.zeros(BATCH, length),
        yes,
        yes,
        [""] * BATCH,
        context=Context((torch.randn(BATCH, 2, 16, 4, 4),)),
    )


def imagine(model: ActionWorldModelRewardModel, clip: Clip) -> list[Imagined]:
    """Step by step from the clip's first frame."""
    state = model.start(clip.first(), dtype=torch.float32)
    return [model.step(state, action) for action in clip.action.unbind(1)]


def over_time(steps: list[Imagined], name: str) -> Tensor:
    return torch.stack([getattr(step, name) for step in steps], 1)


def test_steps_are_one_pass_over_the_clip():
    model, clip = world_model(), random_clip()
    steps, whole = imagine(model, clip), model.predict(clip)
    codebook = model.dynamics.network.codebook
    assert torch.equal(over_time(steps, "tokens"), codebook.tokens(codebook.most_likely(whole.logits)))
    torch.testing.assert_close(over_time(steps, "done_logit"), whole.done_logit, atol=1e-4, rtol=0)
    torch.testing.assert_close(over_time(steps, "hidden"), whole.hidden, atol=1e-4, rtol=0)
    state = whole.state * model.state_std + model.state_mean
    torch.testing.assert_close(over_time(steps, "state"), state, atol=1e-4, rtol=0)


def test_what_is_not_drawn_is_predicted_all_the_same():
    model, clip = world_model(), random_clip()
    drawn, undrawn = model.predict(clip), model.predict(clip, with_tokens=False)
    assert undrawn.logits.shape == (BATCH, 0, *drawn.logits.shape[2:])
    assert all(torch.equal(a, b) for a, b in zip(drawn[1:], undrawn[1:], strict=True))


@pytest.mark.parametrize("length", [LENGTH, 2 * LENGTH])
def test_looking_ahead_ends_where_steps_do(length):
    """In one pass, and by steps where imagination begins anew on the way."""
    model, clip = world_model(), random_clip(length=length)
    steps = imagine(model, clip)
    ahead = model.open_loop(clip.first(), clip.action)
    assert torch.equal(ahead.tokens, steps[-1].tokens)
    for name in ("done_logit", "state"):
        torch.testing.assert_close(getattr(ahead, name), over_time(steps, name), atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("with_tokens", [True, False])
def test_many_sequences_from_one_frame_are_predicted_as_each_alone(with_tokens):
    model, clip = world_model(), random_clip()
    frames, others = clip.first(), random_clip(seed=1)
    actions = torch.stack([clip.action, others.action], 1).flatten(0, 1)  # two sequences for each frame
    together = model.open_loop(frames, actions, with_tokens)
    for index, one in enumerate((clip.action, others.action)):
        alone = model.open_loop(frames, one)
        for name in ("done_logit", "state"):
            found = getattr(together, name)[index::2]
            torch.testing.assert_close(found, getattr(alone, name), atol=1e-4, rtol=1e-4)
        if with_tokens:
            assert torch.equal(together.tokens[index::2], alone.tokens)
        else:
            assert together.tokens is None


def test_nothing_comes_from_the_future_nor_from_later_frames():
    model, clip = world_model(), random_clip()
    before = model.predict(clip)
    other = random_clip(seed=1)
    changed = torch.cat([clip.tokens[:, :1], other.tokens[:, 1:]], 1)
    moved = torch.cat([clip.state[:, :1], other.state[:, 1:]], 1)
    unseen = model.predict(clip._replace(tokens=changed, state=moved))
    assert all(torch.equal(a, b) for a, b in zip(before, unseen, strict=True))
    actions = torch.cat([clip.action[:, :3], other.action[:, 3:]], 1)
    after = model.predict(clip._replace(action=actions))
    for a, b in zip(before[:4], after[:4], strict=True):
        torch.testing.assert_close(a[:, :3], b[:, :3], atol=1e-5, rtol=0)
        assert (a[:, 3:] - b[:, 3:]).abs().max() > 1e-3


def test_whoever_has_imagined_a_clip_begins_anew_at_its_last_frame():
    model, clip = world_model(), random_clip(length=2 * LENGTH)
    steps = imagine(model, clip)
    last = steps[LENGTH - 1]
    again = model.start(Frames(last.tokens, last.state, clip.context), dtype=torch.float32)
    for step, action in zip(steps[LENGTH:], clip.action[:, LENGTH:].unbind(1), strict=True):
        anew = model.step(again, action)
        assert torch.equal(anew.tokens, step.tokens)
        torch.testing.assert_close(anew.done_logit, step.done_logit, atol=1e-4, rtol=0)


def test_a_restarted_imagination_is_a_new_one():
    model, clip, new = world_model(), random_clip(length=2 * LENGTH), random_clip(seed=1)
    whole = over_time(imagine(model, clip), "tokens")
    running = model.start(clip.first(), dtype=torch.float32)
    before = [model.step(running, action) for action in clip.action[:, :4].unbind(1)]
    model.restart(running, torch.tensor([True, False, False]), new.first())
    after = [model.step(running, action) for action in clip.action[:, 4:].unbind(1)]
    assert torch.equal(over_time(before + after, "tokens")[1:], whole[1:])
    fresh = new._replace(action=clip.action[:, 4:])
    assert torch.equal(over_time(after, "tokens")[0], over_time(imagine(model, fresh), "tokens")[0])


def test_the_text_model_imagines_the_same_way():
    torch.manual_seed(0)
    model = TextWorldModelRewardModel(TextWorldModelConfig(**nested(SIZES))).eval()
    for parameter in model.dynamics.network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    clip = random_clip()._replace(instructions=["push the can", "pull the box", "push the can"])
    state = model.start(clip.first(), clip.instructions, dtype=torch.float32)
    steps = [model.step(state) for _ in range(LENGTH)]
    expected = model.predict(clip).done_logit
    torch.testing.assert_close(over_time(steps, "done_logit"), expected, atol=1e-4, rtol=0)
    assert model(clip)[0].isfinite()


def test_what_the_tokenizer_sees_in_the_first_frame_is_looked_at_and_needed():
    model, clip = world_model(), random_clip()
    before = model.predict(clip)
    other = model.predict(clip._replace(context=random_clip(seed=1).context))
    assert all((a - b).abs().max() > 1e-3 for a, b in zip(before[:4], other[:4], strict=True))
    alone = clip._replace(context=NO_CONTEXT)
    for ask in (lambda: model.predict(alone), lambda: imagine(model, alone)):
        with pytest.raises(ValueError, match=r"the context of 0 first frames for 3 imaginations"):
            ask()
    assert world_model(tokenizer=small_tokenizer(cameras=CAMERAS)).predict(alone).done_logit.isfinite().all()


def reached(clip: Clip) -> Clip:
    """Done where the first action's sum has passed 1; then all tokens change."""
    done = clip.action[..., 0].cumsum(1) > 1
    later = torch.cat([torch.zeros(BATCH, 1, dtype=torch.bool), done[:, :-1]], 1)
    first = clip.tokens[:, :1]
    tokens = torch.where(later[..., None], (first + 7) % CODES, first)
    moved = 0.2 * clip.action[:, :-1, 0].cumsum(1)
    state = torch.cat([moved.new_zeros(BATCH, 1), moved], 1)[..., None]
    return clip._replace(tokens=tokens, state=state, done=done.float())


def test_frames_done_and_state_are_learnt_though_few_frames_are_drawn(monkeypatch):
    monkeypatch.setattr(anchored_dynamics, "RENDERED_FRAMES", 1)
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.0)
    torch.manual_seed(0)
    model = ActionWorldModelRewardModel(ActionWorldModelConfig(**nested(SIZES | {"state_size": 1}))).train()
    clip = reached(random_clip())
    assert 0 < clip.done.mean() < 1
    optimizer = torch.optim.Adam(model.dynamics.network.parameters(), 3e-3)
    for _ in range(300):
        loss, _ = model(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    steps = imagine(model.eval(), clip)
    assert torch.equal(over_time(steps, "done_logit") > 0, clip.done > 0.5)
    assert (over_time(steps, "tokens")[:, :-1] == clip.tokens[:, 1:]).float().mean() > 0.9
    assert (over_time(steps, "state")[:, :-1] - clip.state[:, 1:]).abs().mean() < 0.03


def test_training_leaves_out_a_share_of_what_layers_add_and_imagination_nothing():
    model, clip = world_model(dropout=0.5), random_clip()
    plain, again = world_model().predict(clip), model.predict(clip)
    assert torch.equal(plain.done_logit, again.done_logit)
    model.train()
    ways = torch.stack([model.predict(clip).done_logit for _ in range(2)])
    assert not torch.equal(ways[0], ways[1])
    left = Dropout(0.5).train()(torch.ones(4, 1000))
    assert set(left.unique().tolist()) == {0.0, 2.0}
    assert left.mean(1).sub(1).abs().max() < 0.15


def test_steps_are_sampled_among_those_with_a_valid_next_one():
    valid = torch.tensor([[True] * 6, [True] * 3 + [False] * 3, [True] + [False] * 5])
    rows = torch.stack([sample_steps(valid, 5) for _ in range(200)])
    assert [sorted(set(rows[:, clip].flatten().tolist())) for clip in range(3)] == [
        [0, 1, 2, 3, 4],
        [0, 1],
        [0],
    ]


def test_tokens_that_are_not_as_at_the_start_count_more_and_padding_nothing(monkeypatch):
    monkeypatch.setattr(losses, "MOVING_TOKEN_WEIGHT", 2.0)
    codebook, clip = CodeBook([5, 4]), random_clip()
    valid = clip.valid.clone()
    valid[1, 2:] = False
    tokens = clip.tokens.clone()
    tokens[0, 3] = tokens[0, 0]
    codes, steps = codebook.codes(tokens), torch.tensor([[2], [1], [0]])
    known, target = (take_steps(x, steps) for x in (known_transitions(valid), codes[:, 1:]))
    frames = losses.weighted_frames(codebook, target, codes[:, :1], known)
    assert torch.equal(frames.codes[0], codebook.codes(tokens[0, 3:4]))
    assert torch.equal(frames.weight[0], torch.ones(1, TOKENS))
    assert torch.equal(frames.weight[1], torch.zeros(1, TOKENS))
    assert set(frames.weight[2].unique().tolist()) == {1.0, 3.0}
    assert torch.equal(frames.moved, frames.weight == 3)


@pytest.mark.parametrize("setting", ["window", "depth", "self_rollout", "maskgit_steps", "keypoint_weight"])
def test_what_anchored_dynamics_do_not_have_cannot_be_set(setting):
    flags = ["--model.type=action_world_model", "--model.device=cpu", f"--model.dynamics.{setting}=1"]
    with pytest.raises(DecodingError, match=setting):
        parse(TrainWorldModelConfig, args=flags)


@pytest.mark.parametrize("setting", [{"dropout": 1.0}, {"dropout": -0.1}])
def test_shares_that_are_none_are_named(setting):
    name, value = next(iter(setting.items()))
    with pytest.raises(FieldError, match=rf"^dynamics.{name}={value}: must be a share"):
        AnchoredConfig(**setting)
    with pytest.raises(FieldError, match=r"^from_start=1.5: must be between 0 and 1"):
        ActionWorldModelConfig(device="cpu", from_start=1.5)


def test_noise_of_what_hardly_varies_does_not_weigh_as_much_as_motion():
    spread = torch.tensor([0.07, 0.002, 0.0, 0.03, 0.03, 0.03, 0.03, 0.4])
    model = ActionWorldModelRewardModel(
        ActionWorldModelConfig(**nested(SIZES)),
        dataset_stats={
            "observation.state": {"mean": torch.zeros(8), "std": spread},
            "action": {"mean": torch.zeros(7), "std": torch.full((7,), 0.01)},
        },
    )
    expected = torch.tensor([0.07, STATE_MIN_STD, 1.0, 0.03, 0.03, 0.03, 0.03, 0.4])
    torch.testing.assert_close(model.state_std, expected)
    torch.testing.assert_close(model.action_std, torch.full((7,), 0.01))


def model_of_spread(robot: Embodiment, spread: torch.Tensor) -> ActionWorldModelRewardModel:
    """A model of data whose actions vary by so much. (7,)"""
    return ActionWorldModelRewardModel(
        ActionWorldModelConfig(**nested(SIZES), embodiment=robot),
        dataset_stats={
            "observation.state": {"mean": torch.zeros(8), "std": torch.ones(8)},
            "action": {"mean": torch.zeros(7), "std": spread},
        },
    )


def test_small_actions_are_scaled_if_their_range_is_small():
    """Displacements in metres, one of them idle but for its noise, and one constant."""
    robot = Embodiment(action_low=[-0.002] * 5 + [-1e-7, 0.3], action_high=[0.002] * 5 + [1e-7, 0.3])
    spread = torch.tensor([7e-4] * 5 + [1e-7, 0.0])
    model = model_of_spread(robot, spread)
    torch.testing.assert_close(model.action_std, torch.tensor([7e-4] * 5 + [1.0, 1.0]))


def test_small_displacements_are_scaled_beside_a_gripper_of_a_large_range():
    robot = Embodiment(action_low=[-0.002] * 6 + [0.0], action_high=[0.002] * 6 + [100.0])
    spread = torch.tensor([7e-4] * 5 + [1e-7, 40.0])
    model = model_of_spread(robot, spread)
    torch.testing.assert_close(model.action_std, torch.tensor([7e-4] * 5 + [1.0, 40.0]))


def test_a_component_that_varies_by_one_is_not_taken_for_a_constant_one():
    """A planner leaves components alone whose standard deviation is 1."""
    robot = Embodiment(action_low=[-1.0] * 7, action_high=[1.0] * 7)
    model = model_of_spread(robot, torch.tensor([1.0, 0.0, *[0.5] * 5]))
    assert (model.action_std == 1).tolist() == [False, True, *[False] * 5]
