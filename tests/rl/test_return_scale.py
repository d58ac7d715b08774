"""The running scale of returns."""

import pytest
import torch

from lerobot_wmrl.rl.return_scale import ReturnScale


def test_before_the_first_returns_nothing_changes() -> None:
    scale, returns = ReturnScale(), torch.randn(50) * 300
    assert torch.equal(scale.normalise(returns), returns)
    assert torch.equal(scale.restore(returns), returns)


def test_returns_become_of_unit_size_from_the_first_iteration_on() -> None:
    torch.manual_seed(0)
    scale, returns = ReturnScale(), torch.randn(4000) * 300 - 900
    scale.update(returns)
    normalised = scale.normalise(returns)
    assert normalised.mean().abs() < 1e-4
    assert normalised.std().item() == pytest.approx(1, abs=1e-3)
    assert torch.allclose(scale.restore(normalised), returns, atol=1e-2)


def test_the_scale_follows_returns_that_grow() -> None:
    scale = ReturnScale()
    for mean in (0.0,) * 20 + (50.0,) * 40:
        scale.update(torch.randn(1000) + mean)
    assert scale.restore(torch.zeros(())).item() == pytest.approx(50, abs=1)


def test_constant_returns_do_not_explode() -> None:
    scale = ReturnScale()
    scale.update(torch.full((10,), 2.0))
    assert scale.normalise(torch.full((10,), 2.0)).abs().max() < 1e-3
