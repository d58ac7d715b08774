"""Where there is no CUDA, and outside of a training that allows it, a module is called as it is."""

import copy

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


def test_a_copy_of_a_network_unrolls_with_its_own_weights() -> None:
    network = ActionWorldModelRewardModel(ActionWorldModelConfig(**nested(SIZES))).dynamics.network
    other = copy.deepcopy(network)
    assert other._unroll._module is other.state_rollout
    assert other.state_rollout is not network.state_rollout
