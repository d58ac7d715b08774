import pytest
import torch

from lerobot_wmrl.world_models.st_transformer import SpatialTemporalTransformer

WINDOW = 5


@pytest.fixture
def transformer() -> SpatialTemporalTransformer:
    torch.manual_seed(0)
    model = SpatialTemporalTransformer(layers=2, width=16, heads=2, window=WINDOW).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return model


def unroll(model: SpatialTemporalTransformer, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
    cache = model.make_cache(x.shape[0], x.shape[2], x.device, x.dtype)
    steps = [model.step(x[:, t : t + 1], condition[:, t : t + 1], None, cache) for t in range(x.shape[1])]
    return torch.cat(steps, 1)


@torch.no_grad()
def test_cached_steps_equal_the_uncached_pass_also_after_the_ring_wraps(transformer):
    x, condition = torch.randn(3, 4 * WINDOW, 6, 16), torch.randn(3, 4 * WINDOW, 2, 16)
    torch.testing.assert_close(
        unroll(transformer, x, condition), transformer(x, condition), atol=1e-5, rtol=1e-4
    )


@torch.no_grad()
def test_no_frame_sees_the_future_or_beyond_the_receptive_field(transformer):
    x, condition = torch.randn(1, 16, 6, 16), torch.randn(1, 16, 2, 16)
    before = transformer(x, condition)
    x[:, 4] = torch.randn(6, 16)
    moved = (transformer(x, condition) - before).abs().amax((0, 2, 3)) > 1e-6
    reach = 2 * (WINDOW - 1)
    assert moved.tolist() == [4 <= t <= 4 + reach for t in range(16)]


@torch.no_grad()
def test_only_relative_time_matters(transformer):
    x, condition = torch.randn(2, 3, 6, 16), torch.randn(2, 3, 2, 16)
    cache = transformer.make_cache(2, 6, x.device, x.dtype)
    cache.position = 1_001
    cache.started[:] = 1_001
    late = [transformer.step(x[:, t : t + 1], condition[:, t : t + 1], None, cache) for t in range(3)]
    torch.testing.assert_close(torch.cat(late, 1), transformer(x, condition), atol=1e-4, rtol=1e-3)


@torch.no_grad()
def test_a_restarted_environment_forgets_and_the_others_do_not(transformer):
    x, condition = torch.randn(2, 6, 6, 16), torch.randn(2, 6, 2, 16)
    cache = transformer.make_cache(2, 6, x.device, x.dtype)
    for t in range(3):
        transformer.step(x[:, t : t + 1], condition[:, t : t + 1], None, cache)
    cache.started[0] = cache.position
    out = transformer.step(x[:, 3:4], condition[:, 3:4], None, cache)
    torch.testing.assert_close(out[0], transformer(x[:1, 3:4], condition[:1, 3:4])[0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(out[1], transformer(x[1:, :4], condition[1:, :4])[0, 3:], atol=1e-5, rtol=1e-4)
