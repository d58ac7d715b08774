"""MaskGIT decoding in several passes: what is fixed stays, and nothing leaks out of drafts."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.maskgit import (
    DraftMemory,
    FirstPass,
    MaskGit,
    fixed_counts,
    most_confident,
)
from lerobot_wmrl.world_models.autoregressive.network import NextFrameNetwork
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.layers import FrameSizes

LEVELS, TOKENS, WIDTH, FRAMES = (5, 3), 4, 32, 4


def config(passes: int = 0) -> AutoregressiveConfig:
    return AutoregressiveConfig(
        layers=1,
        width=WIDTH,
        heads=2,
        patch=1,
        code_width=16,
        window=FRAMES,
        conditioning="cross_attention",
        maskgit_steps=passes,
    )


def network() -> NextFrameNetwork:
    torch.manual_seed(0)
    return NextFrameNetwork(config(), FrameSizes(LEVELS, "fsq", 2, 1, state_size=0, clip_length=FRAMES))


def maskgit(passes: int) -> MaskGit:
    return MaskGit(config(passes), channels=len(LEVELS))


def frames(batch: int) -> Tensor:
    """Digits: the first counts on from frame to frame, in every token its own way; the second is a coin that
    all tokens of a frame share, thrown anew for every frame. → (B, T, S, 2)"""
    first = (torch.randint(0, 5, (batch, 1, TOKENS)) + torch.arange(FRAMES)[:, None]) % 5
    coin = torch.randint(0, 2, (batch, FRAMES, 1)).expand(-1, -1, TOKENS)
    return torch.stack([first, coin], -1)


def look(model: NextFrameNetwork, codes: Tensor) -> FirstPass:
    """One pass over clips, without state or anything to be told by the condition."""
    batch, length = codes.shape[:2]
    memory = model.clip_memory(length, codes.device)
    condition = Condition(torch.zeros(batch, 1, 1, WIDTH))
    prediction, depth = model(codes, torch.zeros(batch, length, 0), condition, memory)
    return FirstPass(codes, condition, prediction, depth, memory)


def seen_last(model: NextFrameNetwork, codes: Tensor) -> FirstPass:
    """The last of these frames, seen against the cache."""
    cache = model.make_cache(len(codes), codes.device, torch.float32)
    condition, state = Condition(torch.zeros(len(codes), 1, 1, WIDTH)), torch.zeros(len(codes), 1, 0)
    for t in range(codes.shape[1]):
        prediction, depth = model(codes[:, t : t + 1], state, condition, cache.advance())
    return FirstPass(codes[:, -1:], condition, prediction, depth, cache)


def next_frames(model: NextFrameNetwork, decoding: MaskGit, codes: Tensor) -> Tensor:
    """What follows the last of these frames. → (B, S, 2)"""
    return decoding.decode(model, seen_last(model, codes))[:, 0]


@pytest.fixture(scope="module")
def trained() -> tuple[NextFrameNetwork, MaskGit]:
    model, decoding = network(), maskgit(4)
    parameters = [*model.parameters(), *decoding.parameters()]
    optimizer = torch.optim.Adam(parameters, 1e-2)
    weight = torch.ones(16, FRAMES - 1, TOKENS)
    for _ in range(200):
        codes = frames(16)
        seen, target = look(model, codes), codes[:, 1:]
        one_pass = model.codebook.cross_entropy(seen.prediction.logits[:, :-1], target).mean()
        loss = one_pass + decoding.loss(model, seen, target, weight)[0]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.eval(), decoding.eval()


@torch.no_grad()
def test_it_predicts_what_is_certain_and_tokens_of_a_frame_agree_on_what_is_not(trained):
    model, decoding = trained
    codes = frames(64)
    drawn = next_frames(model, decoding, codes[:, :2])
    assert (drawn[..., 0] == codes[:, 2, :, 0]).float().mean() > 0.95
    coin = drawn[..., 1].float().mean(-1)
    assert ((coin < 0.1) | (coin > 0.9)).float().mean() > 0.9


@torch.no_grad()
def test_a_draft_depends_on_what_is_fixed_of_its_own_frame(trained):
    """The purpose of several passes: once one token's coin is known, the others' are."""
    model, decoding = trained
    codes = frames(64)
    seen, target = look(model, codes), torch.cat([codes[:, 1:], codes[:, -1:]], 1)
    fixed = torch.zeros(64, FRAMES, TOKENS, dtype=torch.bool)
    fixed[..., 0] = True
    logits = decoding.draft_logits(model, seen, DraftMemory.after(seen.memory), target, fixed)
    right = model.codebook.most_likely(logits)[:, :-1, 1:, 1] == target[:, :-1, 1:, 1]
    assert right.float().mean() > 0.95
    one_pass = model.codebook.most_likely(seen.prediction.logits)[:, :-1, 1:, 1]
    assert (one_pass == target[:, :-1, 1:, 1]).float().mean() < 0.7


@torch.no_grad()
def test_drafts_against_the_ring_equal_drafts_in_a_clip(trained):
    """Training and imagination see the same past, also after the ring has wrapped."""
    model, decoding = trained
    codes = frames(3).repeat(1, 2, 1, 1)
    seen = look(model, codes)
    fixed = torch.rand(3, 2 * FRAMES, TOKENS) < 0.5
    whole = decoding.draft_logits(model, seen, DraftMemory.after(seen.memory), codes, fixed)
    cache = model.make_cache(3, codes.device, torch.float32)
    for t in range(2 * FRAMES):
        now = slice(t, t + 1)
        prediction, depth = model(codes[:, now], torch.zeros(3, 1, 0), seen.condition, cache.advance())
        frame = FirstPass(codes[:, now], seen.condition, prediction, depth, cache)
        memory = DraftMemory.after(cache)
        draft = decoding.draft_logits(model, frame, memory, codes[:, now], fixed[:, now])
        torch.testing.assert_close(draft, whole[:, now], atol=1e-4, rtol=0)


@pytest.mark.parametrize("passes", [1, 2, 3, 4])
@torch.no_grad()
def test_tokens_once_fixed_are_kept_and_all_are_filled(passes, monkeypatch):
    model, decoding = network().eval(), maskgit(passes)
    drafts: list[tuple[Tensor, Tensor]] = []
    draft_logits = decoding.draft_logits

    def record(model: Any, seen: Any, memory: Any, codes: Tensor, fixed: Tensor) -> Tensor:
        drafts.append((codes, fixed))
        return draft_logits(model, seen, memory, codes, fixed)

    monkeypatch.setattr(decoding, "draft_logits", record)
    final = next_frames(model, decoding, frames(5)[:, :2])
    assert len(drafts) == passes - 1
    assert ((final >= 0) & (final < torch.tensor(LEVELS))).all()
    counts = fixed_counts(TOKENS, passes)
    for (codes, fixed), count in zip(drafts, counts, strict=False):
        assert (fixed.sum(-1) == count).all()
        assert torch.equal(codes[:, 0][fixed[:, 0]], final[fixed[:, 0]])


def test_one_pass_of_maskgit_takes_the_most_likely_codes_at_once():
    model = network().eval()
    seen = seen_last(model, frames(5)[:, :2])
    expected = model.codebook.most_likely(seen.prediction.logits)
    assert torch.equal(maskgit(1).decode(model, seen), expected)


def test_few_tokens_are_fixed_at_first_and_all_at_last():
    assert fixed_counts(16, 4) == [2, 5, 10, 16]
    for tokens in (1, 4, 64, 256):
        for passes in (1, 2, 3, 8, 12):
            counts = fixed_counts(tokens, passes)
            assert counts == sorted(counts)
            assert counts[0] >= 1
            assert counts[-1] == tokens


def test_the_likeliest_tokens_are_fixed_first_and_those_fixed_stay():
    confidence = torch.tensor([[-3.0, -1.0, -4.0, -2.0]])
    nothing, third = torch.zeros(1, 4, dtype=torch.bool), torch.tensor([[False, False, True, False]])
    assert most_confident(confidence, nothing, 2).tolist() == [[False, True, False, True]]
    assert most_confident(confidence, third, 2).tolist() == [[False, True, True, False]]


def test_masked_tokens_learn_and_nothing_leaks_into_them():
    """The loss of a draft depends on what is fixed of its own frame, not on other frames' drafts."""
    model, decoding = network(), maskgit(2)
    codes = frames(2)
    seen = look(model, codes)
    following = torch.cat([codes[:, 1:], codes[:, -1:]], 1)
    fixed = torch.rand(2, FRAMES, TOKENS) < 0.5
    before = decoding.draft_logits(model, seen, DraftMemory.after(seen.memory), following, fixed)
    changed = following.clone()
    changed[:, 1, :, 0] = (changed[:, 1, :, 0] + 1) % 5
    after = decoding.draft_logits(model, seen, DraftMemory.after(seen.memory), changed, fixed)
    assert (after != before).flatten(2).any(-1).tolist() == [[False, True, False, False]] * 2
    hidden = torch.where(fixed[..., None], following, (following + 1) % torch.tensor(LEVELS))
    same = decoding.draft_logits(model, seen, DraftMemory.after(seen.memory), hidden, fixed)
    assert torch.equal(same, before)
