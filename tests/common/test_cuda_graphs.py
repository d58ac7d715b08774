"""Where there is no CUDA, and outside of a training that allows it, a module is called as it is."""

import copy

import pytest
import torch
from torch import nn

from lerobot_wmrl.common.cuda_graphs import ALLOWED, GraphedInTraining, cuda_graphs
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from tests.trained import nested
from tests.world_models.test_anchored import SIZES


def test_elsewhere_it_is_the_module() -> None:
    layer = nn.Linear(2, 3)
    graphed, x = GraphedInTraining(layer), torch.randn(4, 2)
    with cuda_graphs():
        assert ALLOWED.get()
        assert torch.equal(graphed(x), layer(x))
    assert not ALLOWED.get()


class OnCuda(torch.Tensor):
    """A tensor that claims to be on a GPU."""

    is_cuda = True


def test_a_training_that_allows_it_captures_each_shape_once(monkeypatch: pytest.MonkeyPatch) -> None:
    captured: list[tuple[torch.Size, ...]] = []

    def capture(module: nn.Module, samples: tuple[torch.Tensor, ...], **_: object) -> nn.Module:
        captured.append(tuple(sample.shape for sample in samples))
        return module

    monkeypatch.setattr(torch.cuda, "make_graphed_callables", capture)
    layer = nn.Linear(2, 3)
    graphed, x = GraphedInTraining(layer), torch.randn(4, 2).as_subclass(OnCuda)
    graphed(x[:1])  # elsewhere
    with cuda_graphs():
        for each in (x, x, x[:3]):
            assert torch.equal(graphed(each), layer(each))
        with torch.no_grad():
            graphed(x[:2])
        layer.eval()
        graphed(x[:1])
    assert captured == [((4, 2),), ((3, 2),)]


def test_a_copy_of_a_network_unrolls_with_its_own_weights() -> None:
    network = ActionWorldModelRewardModel(ActionWorldModelConfig(**nested(SIZES))).dynamics.network
    other = copy.deepcopy(network)
    assert other._unroll._module is other.state_rollout
    assert other.state_rollout is not network.state_rollout
