"""PPO's arithmetic, and that it learns."""

import copy
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rewards.general import default_discount
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.minibatches import Minibatches, read_batch
from lerobot_wmrl.rl.objective import clipped_objective, kl_estimate, reference_penalty
from lerobot_wmrl.rl.ppo import PPO, generalised_advantages, normalised
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from tests.rl.learning import assert_it_learns, update
from tests.rl.point_env import PointEnv

FAST = {"policy_lr": 3e-3, "value_lr": 3e-3, "target_kl": 0.05, "minibatch_size": 240, "value_iterations": 1}
MakePolicy = Callable[..., CnnPolicy]


def one_rollout(
    policy: CnnPolicy, pipeline: Pipeline, image_size: int = 0, **config: Any
) -> tuple[PPO, RolloutBuffer]:
    """An algorithm and a buffer whose advantages are computed, before any update."""
    algorithm = PPO(policy, PPOConfig(**{"value_iterations": 0, **config}))
    env = PointEnv(16, horizon=6, image_size=image_size)
    buffer = RolloutBuffer(12, 16, "cpu")
    collect(env, policy, pipeline, buffer, seed=0)
    algorithm.add_targets(buffer)
    algorithm.add_reference(buffer, pipeline)
    return algorithm, buffer


@pytest.mark.parametrize("image_size", [0, 32])
def test_before_the_first_update_the_ratio_is_one_and_kl_is_zero(
    make_policy: MakePolicy, pipeline: Pipeline, image_size: int
) -> None:
    algorithm, buffer = one_rollout(make_policy(image_size), pipeline, image_size, initial_std=0.3)
    _, record = algorithm.losses(read_batch(buffer, torch.randperm(192)[:100], pipeline))
    assert record["ratio_error"].max() < 1e-3
    assert record["kl"].abs().max() < 1e-5


def test_positive_advantage_raises_the_log_prob_of_what_was_done(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    for sign in (1.0, -1.0):
        policy = make_policy()
        algorithm, buffer = one_rollout(policy, pipeline, policy_lr=1e-3)
        buffer.columns["advantage"] = torch.full((12, 16), sign)
        batch = read_batch(buffer, torch.arange(192), pipeline)
        algorithm.update(iter(Minibatches(buffer, buffer.decided, pipeline, PPOConfig(epochs=1))))
        moved = policy.evaluate(batch["observation"], batch["raw_action"])[0] - batch["log_prob"]
        assert sign * moved.sum(dim=1).mean() > 1e-3


def test_a_step_that_is_much_too_long_is_undone_and_the_next_are_shorter(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    """Between two minibatches, and after the last one."""
    for size in (48, 192):
        algorithm, buffer = one_rollout(make_policy(), pipeline, policy_lr=1.0)
        minibatches = Minibatches(buffer, buffer.decided, pipeline, PPOConfig(epochs=1, minibatch_size=size))
        before = [parameter.detach().clone() for parameter in algorithm.policy_parameters]
        algorithm.update(iter(minibatches))
        assert all(torch.equal(a, b) for a, b in zip(algorithm.policy_parameters, before, strict=True))
        shortened = algorithm.trust_region.group["lr"]
        assert 0.1 <= shortened < 1
        algorithm.trust_region.group["lr"] = 1e-4
        algorithm.update(iter(minibatches))
        assert algorithm.trust_region.group["lr"] == pytest.approx(1.1e-4), "shorter for a while alone"
        assert not any(torch.equal(a, b) for a, b in zip(algorithm.policy_parameters, before, strict=True))


def test_the_learning_rate_does_not_rise_where_the_target_kl_ends_an_iteration(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    algorithm, buffer = one_rollout(make_policy(), pipeline, policy_lr=5e-3, minibatch_size=32, epochs=9)
    algorithm.trust_region.group["lr"] = 2e-3
    update(algorithm, buffer, pipeline)
    assert algorithm.trust_region.group["lr"] == 2e-3


def test_the_objective_stops_paying_outside_the_clip() -> None:
    log_ratio = torch.tensor([[0.5], [-0.5], [0.5], [-0.5]], requires_grad=True)
    clipped_objective(log_ratio, torch.tensor([1.0, -1.0, -1.0, 1.0]), 0.2, 0.2).sum().backward()
    assert log_ratio.grad is not None
    assert (log_ratio.grad[:2] == 0).all()
    assert (log_ratio.grad[2:] != 0).all()


def test_kl_estimate_and_penalty_gradient_agree_with_the_gaussian() -> None:
    """KL(N(μ, σ²) ‖ N(0, 1)) and its derivative by μ, which is μ."""
    torch.manual_seed(0)
    mean, std = torch.tensor(0.3, requires_grad=True), torch.tensor(0.8)
    policy, reference = torch.distributions.Normal(mean, std), torch.distributions.Normal(0.0, 1.0)
    samples = policy.sample((400_000, 1))
    log_prob = policy.log_prob(samples)
    exact = torch.distributions.kl_divergence(policy, reference)
    estimate = kl_estimate(log_prob, reference.log_prob(samples)).mean()
    assert estimate.item() == pytest.approx(exact.item(), abs=2e-3)
    reference_penalty(log_prob, reference.log_prob(samples)).mean().backward()
    assert mean.grad is not None
    assert mean.grad.item() == pytest.approx(0.3, abs=0.01)


def test_value_iterations_leave_the_policy_alone(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    algorithm, buffer = one_rollout(policy, pipeline, value_iterations=1)
    before = copy.deepcopy(policy.state_dict())
    update(algorithm, buffer, pipeline)
    changed = {
        name.split(".")[0]
        for name, value in policy.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"critic"}
    update(algorithm, buffer, pipeline)
    assert not torch.equal(policy.actor[-1].weight, before["actor.5.weight"])
    reference = algorithm.reference.state_dict()
    assert all(torch.equal(reference[name], value) for name, value in before.items())


def test_a_kept_encoder_encodes_each_frame_once_and_changes_nothing_else(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    """The first rollout is that of an encoder that learns; after the update the encoder is as it was."""
    policies = [make_policy(32) for _ in range(2)]
    policies[1].load_state_dict(policies[0].state_dict())
    buffers, seen = [], []
    for policy, train_encoder in zip(policies, (True, False), strict=True):
        encoded: list[int] = []
        policy.encoder.register_forward_hook(lambda *call, counts=encoded: counts.append(len(call[2])))
        config = PPOConfig(value_iterations=0, train_encoder=train_encoder, policy_lr=1e-3)
        algorithm, buffer = PPO(policy, config), RolloutBuffer(12, 16, "cpu")
        env = PointEnv(16, horizon=6, image_size=32)
        before = copy.deepcopy(policy.encoder.state_dict())
        stats = algorithm.iterate(env, pipeline, buffer, seed=0, last=False)
        assert stats["first_ratio_error"] < 1e-3
        buffers.append(buffer)
        seen.append(sum(encoded))
        same = [torch.equal(value, before[name]) for name, value in policy.encoder.state_dict().items()]
        assert all(same) is not train_encoder
        kept, trained = policy.encoder.parameters(), {id(each) for each in algorithm.policy_parameters}
        assert trained.isdisjoint(map(id, kept)) is not train_encoder
    for name in ("raw_action", "log_prob", "value", "reward"):
        torch.testing.assert_close(*(getattr(buffer, name) for buffer in buffers))
    steps_and_ends = 12 * 16 + 2 * 16 + 16
    assert seen[1] == steps_and_ends < seen[0] / 3


def test_updates_stop_at_the_target_kl(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    algorithm, buffer = one_rollout(make_policy(), pipeline, policy_lr=5e-3, minibatch_size=32, epochs=9)
    stats = update(algorithm, buffer, pipeline)
    assert 1 < stats.extra["updates"] < 9 * 6


def test_training_stops_before_a_bad_step(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    algorithm, buffer = one_rollout(policy, pipeline)
    before = copy.deepcopy(policy.state_dict())
    buffer.columns["advantage"] = torch.full_like(buffer.columns["advantage"], torch.nan)
    minibatches = Minibatches(buffer, buffer.decided, pipeline, PPOConfig(epochs=1, minibatch_size=64))
    with pytest.raises(TrainingStopped, match="not finite"):
        algorithm.update(iter(minibatches))
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_training_stops_far_from_the_reference(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    algorithm, buffer = one_rollout(policy, pipeline, policy_lr=1e-3, max_reference_kl=1e-4)
    update(algorithm, buffer, pipeline)
    collect(PointEnv(16, horizon=6), policy, pipeline, buffer, seed=0)
    with pytest.raises(TrainingStopped, match="max_reference_kl"):
        algorithm.make_minibatches(buffer, pipeline)


def test_training_stops_where_nothing_is_rewarded(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    """The count begins again with any reward."""
    rewards = iter([0.0, 1.0, 0.0, 0.0])

    class Paid(PointEnv):
        def step(self, actions: Any) -> Any:
            observation, reward, *rest = super().step(actions)
            return observation, reward * paid, *rest

    algorithm, buffer = PPO(make_policy(), PPOConfig(patience=2)), RolloutBuffer(6, 16, "cpu")
    for _ in range(3):
        paid = next(rewards)
        algorithm.iterate(Paid(16, horizon=6), pipeline, buffer, seed=0, last=False)
    paid = next(rewards)
    with pytest.raises(
        TrainingStopped, match=r"no episode was rewarded in 2 iterations.*env\.done_threshold"
    ):
        algorithm.iterate(Paid(16, horizon=6), pipeline, buffer, seed=0, last=False)


def test_a_policy_without_log_probs_is_refused() -> None:
    policy = SimpleNamespace(config=SimpleNamespace(type="diffusion"))
    with pytest.raises(ValueError, match=r"policy\.type=diffusion: .*for example cnn, or one of act"):
        PPO(policy, PPOConfig())


def test_ppo_learns_to_reach(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    env, buffer = PointEnv(64), RolloutBuffer(15, 64, "cpu")
    algorithm = PPO(policy, PPOConfig(**FAST, reference_coefficient=0.0))
    assert_it_learns(algorithm, env, buffer, pipeline, 26)


def test_the_reference_holds_the_policy(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    """The same training with a heavy penalty stays nearer to where it began."""
    distance = {}
    for coefficient in (0.0, 3.0):
        torch.manual_seed(0)
        policy = make_policy()
        env, buffer = PointEnv(64), RolloutBuffer(15, 64, "cpu")
        algorithm = PPO(policy, PPOConfig(**FAST, reference_coefficient=coefficient))
        for iteration in range(6):
            collect(env, policy, pipeline, buffer, 64 * iteration)
            update(algorithm, buffer, pipeline)
        distance[coefficient] = algorithm.add_reference(buffer, pipeline)
    assert distance[3.0] < 0.5 * distance[0.0]


def test_targets_have_the_discount_of_the_longest_episode_and_gradients_are_clipped(
    make_policy: MakePolicy, pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = make_policy()
    algorithm = PPO(policy, PPOConfig(value_iterations=0, value_normalisation=False, policy_lr=1e-3))
    buffer = RolloutBuffer(12, 16, "cpu", longest=6)
    collect(PointEnv(16, horizon=6), policy, pipeline, buffer, seed=0)
    algorithm.add_targets(buffer)
    advantages = generalised_advantages(
        buffer.reward,
        buffer.value,
        buffer.next_value,
        buffer.terminated,
        buffer.truncated,
        default_discount(6),
        algorithm.config.gae_lambda,
        buffer.decided,
    )
    torch.testing.assert_close(buffer.columns["target"], advantages + buffer.value)
    torch.testing.assert_close(buffer.columns["advantage"], normalised(advantages, buffer.decided))
    algorithm.add_reference(buffer, pipeline)
    buffer.columns["advantage"] *= 1e4
    norms: list[float] = []

    def step(*_: Any, **__: Any) -> None:
        norms.append(torch.stack([p.grad.norm() for p in algorithm.policy_parameters]).norm().item())

    monkeypatch.setattr(algorithm.optimizer, "step", step)
    update(algorithm, buffer, pipeline)
    assert norms == pytest.approx([1.0] * len(norms), abs=1e-3)
