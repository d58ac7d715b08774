"""What PPO and GRPO share: passes, the reference, what a checkpoint keeps."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.errors import FieldError, TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from tests.rl.chunk_policy import ChunkPolicy
from tests.rl.learning import update
from tests.rl.point_env import PointEnv

MakePolicy = Callable[..., CnnPolicy]


def improved(policy: CnnPolicy, pipeline: Pipeline, iterations: int = 2, **settings: Any) -> tuple[PPO, Any]:
    """`policy` after some iterations of PPO, and what the last one logged."""
    torch.manual_seed(1)
    options = {"value_iterations": 0, "minibatch_size": 70, "policy_lr": 1e-3, **settings}
    algorithm = PPO(policy, PPOConfig(**options))
    env, buffer = PointEnv(16, horizon=6), RolloutBuffer(12, 16, "cpu")
    for iteration in range(iterations):
        collect(env, policy, pipeline, buffer, 16 * iteration)
        stats = update(algorithm, buffer, pipeline)
    return algorithm, stats.to_log_dict()


@pytest.mark.parametrize("settings", [{}, {"ratio": "token", "value_normalisation": True}])
def test_passes_of_a_minibatch_give_its_gradient(
    make_policy: MakePolicy, pipeline: Pipeline, settings: dict[str, Any]
) -> None:
    initial = make_policy()
    (whole, logged), (in_passes, logged_in_passes) = (
        improved(copy.deepcopy(initial), pipeline, micro_batch_size=size, **settings) for size in (None, 16)
    )
    for name, value in whole.policy.state_dict().items():
        torch.testing.assert_close(in_passes.policy.state_dict()[name], value, rtol=1e-4, atol=1e-6)
    assert logged_in_passes == pytest.approx(logged, rel=1e-3, abs=1e-5)
    assert not torch.equal(whole.policy.actor[-1].weight, initial.actor[-1].weight)


def test_clip_fraction_and_norms_are_logged(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    _, gentle = improved(make_policy(), pipeline, policy_lr=1e-6)
    _, bold = improved(make_policy(), pipeline, policy_lr=3e-2, target_kl=10.0, clip=0.05)
    assert gentle["clip_fraction"] == 0
    assert bold["clip_fraction"] > 0.1
    assert bold["policy_grad_norm"] > 0
    assert bold["value_grad_norm"] > 0


def test_the_reference_shares_what_is_not_trained(make_policy: MakePolicy) -> None:
    """A large frozen network under LoRA is in memory once."""
    policy = make_policy()
    policy.actor[0].requires_grad_(False)
    algorithm = PPO(policy, PPOConfig())
    assert algorithm.reference.actor[0].weight is policy.actor[0].weight
    assert algorithm.reference.actor[-1].weight is not policy.actor[-1].weight
    assert policy.actor[-1].weight.requires_grad
    assert not any(parameter.requires_grad for parameter in algorithm.reference.parameters())


def test_the_value_learns_large_returns_only_if_they_are_normalised(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    """Returns of about −1000, as Pendulum's: by Huber's loss a value takes thousands of updates there."""
    explained = {}
    for normalisation in (False, True):
        torch.manual_seed(0)
        policy = make_policy()
        settings = {"value_normalisation": normalisation, "value_iterations": 99, "value_lr": 3e-3}
        algorithm = PPO(policy, PPOConfig(**settings, minibatch_size=64, gamma=0.5))
        env, buffer = PointEnv(32, horizon=6), RolloutBuffer(12, 32, "cpu")
        for iteration in range(12):
            collect(env, policy, pipeline, buffer, 32 * iteration)
            state = buffer.observations.tensors["observation.state"]
            buffer.reward = -1000 * (state[..., :2] - state[..., 2:]).norm(dim=-1)
            stats = update(algorithm, buffer, pipeline)
        explained[normalisation] = stats.extra["explained_variance"]
    assert explained[True] > 0.5 > explained[False]


def test_a_checkpoint_keeps_the_scale_of_the_returns_apart_from_the_policy(
    make_policy: MakePolicy, pipeline: Pipeline, tmp_path: Path
) -> None:
    algorithm, _ = improved(make_policy(), pipeline, value_normalisation=True)
    algorithm.save_pretrained(tmp_path)
    loaded = PPO.from_pretrained(tmp_path, policy=make_policy())
    assert loaded.config == algorithm.config
    returns = torch.randn(5)
    assert torch.equal(loaded.return_scale.normalise(returns), algorithm.return_scale.normalise(returns))
    assert not torch.equal(loaded.return_scale.normalise(returns), returns)
    with pytest.raises(ValueError, match=r"its tensors are \['returns"):
        loaded.load_state_dict({"std": torch.zeros(())})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"clip": 0.0}, r"clip=0\.0"),
        ({"micro_batch_size": 0}, r"micro_batch_size=0"),
        ({"ratio": "sentence"}, "ratio=sentence: choose one of action, token"),
        ({"initial_std": 0.0}, r"^initial_std=0\.0: must be above 0"),
        ({"reference_coefficient": -0.1}, r"^reference_coefficient=-0\.1: must be at least 0"),
        ({"max_reference_kl": 0.0}, r"^max_reference_kl=0\.0: must be above 0"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PPOConfig(**settings)


def test_a_std_that_the_policy_refuses_is_named_as_the_algorithm_s(make_policy: MakePolicy) -> None:
    with pytest.raises(FieldError, match=r"^algorithm\.initial_std=9\.0: must be between"):
        PPO(make_policy(), PPOConfig(initial_std=9.0))


def test_the_kl_to_the_reference_is_that_of_the_rollout_s_policy(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    """In the first iteration this is the reference itself; the update moves away."""
    _, first = improved(make_policy(), pipeline, iterations=1, target_kl=10.0)
    assert first["reference_kl"] == pytest.approx(0, abs=1e-5)
    _, second = improved(make_policy(), pipeline, iterations=2, target_kl=10.0)
    assert second["reference_kl"] > 1e-5


class Dropping(ChunkPolicy):
    """Its layers behave otherwise while a network is trained by a cloning loss."""

    def __init__(self) -> None:
        super().__init__(1)
        self.actor = nn.Sequential(nn.Linear(4, 32), nn.BatchNorm1d(32), nn.Dropout(0.5), nn.Linear(32, 3))


def test_batch_norm_and_dropout_rest_in_rollouts_and_updates(pipeline: Pipeline) -> None:
    torch.manual_seed(0)
    policy = Dropping().train()
    algorithm, buffer = PPO(policy, PPOConfig(value_iterations=0)), RolloutBuffer(12, 16, "cpu")
    for iteration in range(2):
        collect(PointEnv(16, horizon=6), algorithm.policy, pipeline, buffer, 16 * iteration)
        assert update(algorithm, buffer, pipeline).extra["first_ratio_error"] < 1e-3
    assert not any(module.training for module in (*policy.modules(), *algorithm.reference.modules()))
    assert (policy.actor[1].running_mean == 0).all()


class Root(torch.autograd.Function):
    """Finite itself, with a slope that is not."""

    @staticmethod
    def forward(context: Any, value: torch.Tensor) -> torch.Tensor:
        return value.clone()

    @staticmethod
    def backward(context: Any, gradient: torch.Tensor) -> torch.Tensor:
        return gradient * torch.inf


class Steep(ChunkPolicy):
    """Its value is finite, the gradient of it is not."""

    def value(self, observation: dict[str, Any]) -> torch.Tensor:
        return Root.apply(super().value(observation))


def test_a_gradient_that_is_not_finite_spoils_no_weights(pipeline: Pipeline) -> None:
    """Else those of an iteration's last minibatch would be saved."""
    torch.manual_seed(0)
    policy = Steep(1)
    before = copy.deepcopy(policy.state_dict())
    algorithm, buffer = PPO(policy, PPOConfig(epochs=1, minibatch_size=192)), RolloutBuffer(12, 16, "cpu")
    collect(PointEnv(16, horizon=6), policy, pipeline, buffer, 0)
    with pytest.raises(TrainingStopped, match=r"iteration 1: value_grad_norm is not finite"):
        update(algorithm, buffer, pipeline)
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())
