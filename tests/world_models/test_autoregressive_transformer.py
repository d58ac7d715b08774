"""The imagination's ring against one long pass, causality, restarts: for every kind of conditioning."""

import pytest
import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.world_models.autoregressive.configuration import CONDITIONINGS, AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.network import CONDITIONING_CLASSES, SpatialTemporalTransformer
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.kv_cache import KVCache
from lerobot_wmrl.world_models.layers import ClipMemory

WINDOW, TOKENS, WIDTH = 5, 6, 16


@pytest.fixture(params=list(CONDITIONING_CLASSES))
def transformer(request: pytest.FixtureRequest) -> SpatialTemporalTransformer:
    torch.manual_seed(0)
    model = SpatialTemporalTransformer(2, WIDTH, 2, request.param).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return model


def clips(batch: int, length: int) -> tuple[Tensor, Tensor]:
    """Frames and a condition of two tokens each."""
    return torch.randn(batch, length, TOKENS, WIDTH), torch.randn(batch, length, 2, WIDTH)


def make_cache(model: SpatialTemporalTransformer, batch: int, grows: bool = True) -> KVCache:
    shape = (len(model.blocks), batch, TOKENS, 2, WINDOW, WIDTH // 2)
    return KVCache.empty(shape, torch.device("cpu"), torch.float32, grows)


def whole(
    model: SpatialTemporalTransformer, x: Tensor, condition: Tensor, mask: Tensor | None = None
) -> Tensor:
    """One pass over clips."""
    memory = ClipMemory(x.shape[1], WINDOW, WIDTH // 2, x.device)
    return model(x, Condition(condition, mask), memory)[0]


def step(model: SpatialTemporalTransformer, x: Tensor, condition: Tensor, cache: KVCache, t: int) -> Tensor:
    """Frame t of clips against the cache."""
    return model(x[:, t : t + 1], Condition(condition[:, t : t + 1]), cache.advance())[0]


def unroll(
    model: SpatialTemporalTransformer, x: Tensor, condition: Tensor, grows: bool = True, begin: int = 0
) -> Tensor:
    cache = make_cache(model, len(x), grows)
    cache.position[:] = cache.started[:] = begin
    return torch.cat([step(model, x, condition, cache, t) for t in range(x.shape[1])], 1)


def assert_same(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("grows", [True, False])
@torch.no_grad()
def test_cached_steps_equal_one_long_pass_also_after_the_ring_wraps(transformer, grows):
    x, condition = clips(3, 4 * WINDOW)
    assert_same(unroll(transformer, x, condition, grows), whole(transformer, x, condition))


@torch.no_grad()
def test_a_sliding_window_computed_anew_is_something_else(transformer):
    """Deeper layers' cached keys still carry frames that have left the window; a new pass forgets them.

    Until the ring wraps the two agree; afterwards they differ, by a part of what a frame means.
    """
    x, condition = clips(2, 3 * WINDOW)
    cached = unroll(transformer, x, condition)
    windows = [slice(max(0, t + 1 - WINDOW), t + 1) for t in range(x.shape[1])]
    anew = torch.stack([whole(transformer, x[:, part], condition[:, part])[:, -1] for part in windows], 1)
    assert_same(cached[:, :WINDOW], anew[:, :WINDOW])
    share = (cached - anew)[:, WINDOW:].square().mean().sqrt() / cached[:, WINDOW:].square().mean().sqrt()
    print(f"difference of ring and window computed anew: {share:.3f} of the output's root mean square")
    assert 1e-3 < share < 1


def moved_frames(transformer: SpatialTemporalTransformer, changed: str) -> list[int]:
    """Of 16 frames, those whose output changes with frame 4, or with its condition; all others are equal."""
    x, condition = clips(1, 16)
    before = whole(transformer, x, condition)
    frames = {"frame": x, "condition": condition}[changed]
    frames[:, 4] = torch.randn_like(frames[:, 4])
    return (whole(transformer, x, condition) != before).any((0, 2, 3)).nonzero().flatten().tolist()


@torch.no_grad()
def test_no_frame_sees_the_future_or_beyond_the_receptive_field(transformer):
    assert moved_frames(transformer, "frame") == list(range(4, 4 + 2 * (WINDOW - 1) + 1))
    moved = moved_frames(transformer, "condition")
    assert moved[0] == 4
    assert 4 + WINDOW - 1 <= moved[-1] <= 4 + 2 * (WINDOW - 1)


@torch.no_grad()
def test_only_relative_time_matters(transformer):
    x, condition = clips(2, 3)
    late = unroll(transformer, x, condition, grows=False, begin=1_001)
    torch.testing.assert_close(late, whole(transformer, x, condition), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("restart", [3, 2 * WINDOW + 2])
@torch.no_grad()
def test_a_restarted_environment_forgets_and_the_others_do_not(transformer, restart):
    """Before and after the ring has wrapped, until it wraps again."""
    x, condition = clips(2, restart + 2 * WINDOW)
    cache = make_cache(transformer, 2)
    steps = []
    for t in range(x.shape[1]):
        if t == restart:
            cache.restart(torch.tensor([True, False]))
        steps.append(step(transformer, x, condition, cache, t))
    out = torch.cat(steps, 1)
    assert_same(out[:1, restart:], whole(transformer, x[:1, restart:], condition[:1, restart:]))
    assert_same(out[1:], whole(transformer, x[1:], condition[1:]))


@torch.no_grad()
def test_padding_of_the_condition_does_not_count(transformer):
    x = torch.randn(2, 3, TOKENS, WIDTH)
    condition = torch.randn(2, 1, 4, WIDTH)
    mask = torch.tensor([[True, True, False, False], [True] * 4])[:, None, None, None]
    padded = whole(transformer, x, condition, mask)
    assert_same(padded[:1], whole(transformer, x[:1], condition[:1, :, :2]))
    assert_same(padded[1:], whole(transformer, x[1:], condition[1:]))
    assert (padded[0] - whole(transformer, x[:1], condition[:1])[0]).abs().max() > 1e-2


def test_adaptive_norms_begin_as_plain_ones_and_learn():
    model = SpatialTemporalTransformer(1, WIDTH, 2, "adaln")
    x, condition = clips(2, 3)
    torch.testing.assert_close(whole(model, x, condition), whole(model, x, torch.zeros_like(condition)))
    whole(model, x, condition).square().sum().backward()
    (block,) = model.blocks
    assert block.condition.modulation.weight.grad.abs().sum() > 0
    assert block.time.out.weight.grad.abs().sum() > 0


def test_an_unknown_conditioning_is_named():
    with pytest.raises(
        FieldError, match=r"^dynamics.conditioning=film: choose one of adaln, cross_attention"
    ):
        AutoregressiveConfig(conditioning="film")


def test_every_conditioning_of_the_configuration_has_a_class():
    assert set(CONDITIONING_CLASSES) == set(CONDITIONINGS)
