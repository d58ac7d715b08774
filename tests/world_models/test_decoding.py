"""Decoding in several passes: what is fixed stays, and tokens that depend on each other agree."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.world_models.decoding import FramesSeen, MaskGitDecoding, ShiftedDecoding, make_decoding
from lerobot_wmrl.world_models.decoding.maskgit import fixed_counts, largest
from lerobot_wmrl.world_models.next_frame import NextFrameNetwork

LEVELS, TOKENS, WIDTH, FRAMES = (5, 3), 4, 32, 4


def network() -> NextFrameNetwork:
    torch.manual_seed(0)
    return NextFrameNetwork(
        levels=LEVELS, grid=2, num_cameras=1, state_size=0, patch=1, layers=1, width=WIDTH, heads=2,
        window=FRAMES, code_width=16,
    )  # fmt: skip


def maskgit(passes: int) -> MaskGitDecoding:
    decoding = make_decoding(
        SimpleNamespace(decoding="maskgit", maskgit_steps=passes, code_width=16, width=WIDTH),
        channels=len(LEVELS),
    )
    assert isinstance(decoding, MaskGitDecoding)
    return decoding


def frames(batch: int) -> Tensor:
    """Digits: the first counts on from frame to frame, in every token its own way; the second is a coin that
    all tokens of a frame share, thrown anew for every frame. → (B, T, S, 2)"""
    first = (torch.randint(0, 5, (batch, 1, TOKENS)) + torch.arange(FRAMES)[:, None]) % 5
    coin = torch.randint(0, 2, (batch, FRAMES, 1)).expand(-1, -1, TOKENS)
    return torch.stack([first, coin], -1)


def look(model: NextFrameNetwork, digits: Tensor) -> FramesSeen:
    """One pass over clips, without state or anything to be told by the condition."""
    batch, length = digits.shape[:2]
    memory = model.transformer.clip_memory(length, digits.device)
    condition = (torch.zeros(batch, 1, 1, WIDTH), None)
    prediction = model(digits, torch.zeros(batch, length, 0), *condition, memory)
    return FramesSeen(digits, condition, prediction, memory)


def next_frames(
    model: NextFrameNetwork, decoding: ShiftedDecoding, digits: Tensor, temperature: float
) -> Tensor:
    """What follows the last of `digits`, decoded against the ring. → (B, S, 2)"""
    cache = model.transformer.make_cache(len(digits), model.transformer_tokens, digits.device, torch.float32)
    condition, state = (torch.zeros(len(digits), 1, 1, WIDTH), None), torch.zeros(len(digits), 1, 0)
    for t in range(digits.shape[1]):
        prediction = model.step(digits[:, t : t + 1], state, *condition, cache)
    seen = FramesSeen(digits[:, -1:], condition, prediction, cache)
    return decoding.decode(model, seen, temperature, torch.Generator().manual_seed(1))[:, 0]


@pytest.fixture(scope="module")
def trained() -> tuple[NextFrameNetwork, MaskGitDecoding]:
    model, decoding = network(), maskgit(4)
    parameters = [*model.parameters(), *decoding.parameters()]
    optimizer = torch.optim.Adam(parameters, 1e-2)
    weight = torch.ones(16, FRAMES - 1, TOKENS)
    for _ in range(200):
        digits = frames(16)
        seen, target = look(model, digits), digits[:, 1:]
        one_pass = model.codebook.cross_entropy(seen.prediction.logits[:, :-1], target).mean()
        loss = one_pass + decoding.loss(model, seen, target, weight)[0]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.eval(), decoding.eval()


@torch.no_grad()
def test_it_predicts_what_is_certain_and_agrees_on_what_is_not(trained):
    """The purpose of several passes: drawn at once, the tokens of a frame throw their own coins."""
    model, decoding = trained
    digits = frames(64)
    agreeing = {}
    for name, way in {"one pass": ShiftedDecoding(None, 2), "four": decoding}.items():
        drawn = next_frames(model, way, digits[:, :2], temperature=1.0)
        assert (drawn[..., 0] == digits[:, 2, :, 0]).float().mean() > 0.95
        coin = drawn[..., 1].float().mean(-1)
        agreeing[name] = ((coin < 0.1) | (coin > 0.9)).float().mean()
        assert 0.1 < coin.mean() < 0.9
    assert agreeing["one pass"] < 0.5
    assert agreeing["four"] > 0.9


@torch.no_grad()
def test_drafts_against_the_ring_equal_drafts_in_a_clip(trained):
    """Training and imagination see the same past, also after the ring has wrapped."""
    model, decoding = trained
    digits = frames(3).repeat(1, 2, 1, 1)
    seen = look(model, digits)
    fixed = torch.rand(3, 2 * FRAMES, TOKENS) < 0.5
    whole = decoding.draft_logits(model, seen, seen.memory.drafts(), digits, fixed)
    cache = model.transformer.make_cache(3, model.transformer_tokens, digits.device, torch.float32)
    for t in range(2 * FRAMES):
        now = slice(t, t + 1)
        prediction = model.step(digits[:, now], torch.zeros(3, 1, 0), *seen.condition, cache)
        frame = FramesSeen(digits[:, now], seen.condition, prediction, cache)
        draft = decoding.draft_logits(model, frame, cache.drafts(), digits[:, now], fixed[:, now])
        torch.testing.assert_close(draft, whole[:, now], atol=1e-4, rtol=0)


@pytest.mark.parametrize("passes", [1, 2, 3, 4])
@torch.no_grad()
def test_tokens_once_fixed_are_kept_and_all_are_filled(passes, monkeypatch):
    model, decoding = network().eval(), maskgit(passes)
    drafts: list[tuple[Tensor, Tensor]] = []
    draft_logits = decoding.draft_logits

    def record(model: Any, seen: Any, memory: Any, digits: Tensor, fixed: Tensor) -> Tensor:
        drafts.append((digits, fixed))
        return draft_logits(model, seen, memory, digits, fixed)

    monkeypatch.setattr(decoding, "draft_logits", record)
    final = next_frames(model, decoding, frames(5)[:, :2], temperature=1.0)
    assert len(drafts) == passes - 1
    assert ((final >= 0) & (final < torch.tensor(LEVELS))).all()
    counts = fixed_counts(TOKENS, passes)
    for (digits, fixed), count in zip(drafts, counts, strict=False):
        assert (fixed.sum(-1) == count).all()
        assert torch.equal(digits[:, 0][fixed[:, 0]], final[fixed[:, 0]])


def test_one_pass_of_maskgit_is_shifted_decoding():
    model = network().eval()
    digits = frames(5)[:, :2]
    assert torch.equal(
        next_frames(model, maskgit(1), digits, 1.0), next_frames(model, ShiftedDecoding(None, 2), digits, 1.0)
    )


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
    assert largest(confidence, nothing, 2).tolist() == [[False, True, False, True]]
    assert largest(confidence, third, 2).tolist() == [[False, True, True, False]]


def test_masked_tokens_learn_and_nothing_leaks_into_them():
    """The loss of a draft depends on what is fixed of its own frame, not on other frames' drafts."""
    model, decoding = network(), maskgit(2)
    digits = frames(2)
    seen = look(model, digits)
    following = torch.cat([digits[:, 1:], digits[:, -1:]], 1)
    fixed = torch.rand(2, FRAMES, TOKENS) < 0.5
    before = decoding.draft_logits(model, seen, seen.memory.drafts(), following, fixed)
    changed = following.clone()
    changed[:, 1, :, 0] = (changed[:, 1, :, 0] + 1) % 5
    after = decoding.draft_logits(model, seen, seen.memory.drafts(), changed, fixed)
    assert (after != before).flatten(2).any(-1).tolist() == [[False, True, False, False]] * 2
    hidden = torch.where(fixed[..., None], following, (following + 1) % torch.tensor(LEVELS))
    same = decoding.draft_logits(model, seen, seen.memory.drafts(), hidden, fixed)
    assert torch.equal(same, before)


def test_an_unknown_decoding_is_named():
    with pytest.raises(ValueError, match=r"--model\.decoding=beam: choose one of shifted, maskgit"):
        make_decoding(SimpleNamespace(decoding="beam"), channels=2)
