"""A past that was looked at counts as one long forward pass over the real frames would have it."""

import pytest
import torch

from lerobot_wmrl.data.frames import Frames, Past
from tests.trained import small_tokenizer
from tests.world_models.test_anchored import BATCH, CAMERAS, random_clip, world_model

AGO = 2
"""Frames of past."""


def frames_of(clip, row: int) -> Frames:
    return Frames(clip.tokens[:, row], clip.state[:, row], clip.context)


def past_of(clip, first: int) -> Past:
    rows = range(first, first + AGO)
    return Past(tuple(frames_of(clip, row) for row in rows), tuple(clip.action[:, row] for row in rows))


@pytest.fixture(params=["autoregressive", "anchored"])
def model(request):
    anchored = request.param == "anchored"
    memory = {"clip_length": 6} if anchored else {"window": 4}
    tokenizer = small_tokenizer(cameras=CAMERAS, context=anchored)
    return world_model(dynamics=request.param, tokenizer=tokenizer, **memory)


def begun(model, clip, first: int = 0):
    past, now = past_of(clip, first), frames_of(clip, first + AGO)
    return model.start(now, past=past, dtype=torch.float32)


def test_it_is_remembered_as_in_one_pass_over_real_frames(model):
    clip = random_clip()
    state = begun(model, clip)
    imagined = model.step(state, clip.action[:, AGO])
    whole = model.predict(clip)
    torch.testing.assert_close(imagined.done_logit, whole.done_logit[:, AGO], atol=1e-4, rtol=1e-4)
    now = frames_of(clip, AGO)
    alone = model.start(now, dtype=torch.float32)
    forgetful = model.step(alone, clip.action[:, AGO])
    assert (forgetful.done_logit - imagined.done_logit).abs().max() > 1e-2


@pytest.mark.parametrize("before", [1, 3, 7])
def test_who_begins_anew_among_others_is_as_if_all_began(model, before):
    """Also once the ring has gone round."""
    first, second = random_clip(0, before + 6), random_clip(1, before + 6)
    mask = torch.tensor([False, True, False])
    running = begun(model, first)
    for row in range(before):
        model.step(running, first.action[:, row])
    past, now = past_of(second, 0), frames_of(second, AGO)
    model.restart(running, mask, now, past)
    together = [model.step(running, second.action[:, AGO + row]) for row in range(5)]
    fresh = begun(model, second)
    alone = [model.step(fresh, second.action[:, AGO + row]) for row in range(5)]
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one.done_logit[1], other.done_logit[1], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(one.state[1], other.state[1], atol=1e-4, rtol=1e-4)
    unmoved = begun(model, first)
    for row in range(before):
        model.step(unmoved, first.action[:, row])
    unperturbed = model.step(unmoved, second.action[:, AGO])
    rest = ~mask
    torch.testing.assert_close(together[0].done_logit[rest], unperturbed.done_logit[rest])


def test_a_past_longer_than_the_memory_is_refused(model):
    clip = random_clip()
    running = begun(model, clip)
    long = Past(past_of(clip, 0).frames * 2, past_of(clip, 0).actions * 2)
    with pytest.raises(ValueError, match=r"a past of 4 frames.*shorter than the first"):
        model.restart(running, torch.ones(BATCH, dtype=torch.bool), frames_of(clip, AGO), long)
