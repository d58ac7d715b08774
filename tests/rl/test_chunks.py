"""Decisions on several steps: when they are made, what counts of them, what they are worth."""

import pytest
import torch

from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.minibatches import read_batch
from lerobot_wmrl.rl.ppo import PPO, generalised_advantages
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from tests.rl.chunk_policy import ChunkPolicy
from tests.rl.learning import assert_it_learns
from tests.rl.test_rollout import HORIZON, Recorder

CHUNK, STEPS, ENVS = 4, 20, 16
FAST = {"policy_lr": 3e-3, "value_lr": 3e-3, "target_kl": 0.1, "minibatch_size": 120, "value_iterations": 1}
FREE = {"reference_coefficient": 0.0, "max_reference_kl": 1e9}


@pytest.fixture
def rollout(pipeline: Pipeline) -> tuple[Recorder, ChunkPolicy, RolloutBuffer]:
    """Episodes of at most 6 steps, decisions on 4: every episode's second decision is cut."""
    torch.manual_seed(0)
    policy, world, buffer = (
        ChunkPolicy(CHUNK, std=2.0),
        Recorder(ENVS, horizon=HORIZON),
        RolloutBuffer(STEPS, ENVS, "cpu"),
    )
    collect(world, policy, pipeline, buffer, seed=8)
    return world, policy, buffer


def expected_ages(buffer: RolloutBuffer, env: int) -> list[int]:
    """0 at an episode's first step, and every `CHUNK` steps from there."""
    ages, age = [], 0
    for step in range(STEPS):
        ages.append(age)
        age = 0 if buffer.finished[step, env] else (age + 1) % CHUNK
    return ages


def test_a_decision_is_made_when_the_last_is_used_up_and_when_an_episode_begins(
    rollout: tuple[Recorder, ChunkPolicy, RolloutBuffer],
) -> None:
    _, policy, buffer = rollout
    assert buffer.terminated.any()
    for env in range(ENVS):
        assert buffer.age[:, env].tolist() == expected_ages(buffer, env)
    asked = [count for count in buffer.decided.sum(dim=1).tolist() if count]
    assert policy.asked == asked


def test_decisions_are_acted_step_by_step_in_the_environment(
    rollout: tuple[Recorder, ChunkPolicy, RolloutBuffer], pipeline: Pipeline
) -> None:
    world, _, buffer = rollout
    for env in range(ENVS):
        for step in range(STEPS):
            age = int(buffer.age[step, env])
            decided = buffer.raw_action[step - age, env, age]
            assert torch.equal(world.log[step]["action"][env], pipeline.to_action(decided))


def test_what_was_not_acted_counts_for_nothing(
    rollout: tuple[Recorder, ChunkPolicy, RolloutBuffer], pipeline: Pipeline
) -> None:
    """Of a decision that an episode's end cut short, the rest changes neither ratio nor gradient."""
    _, policy, buffer = rollout
    executed = buffer.executed()
    assert executed is not None
    lengths = executed.sum(dim=(2, 3))
    for env in range(ENVS):
        ages = [*buffer.age[:, env].tolist(), 0]
        for step in range(STEPS):
            if ages[step] == 0:
                following = next(ahead for ahead in range(step + 1, STEPS + 1) if ages[ahead] == 0)
                assert lengths[step, env] == following - step
    assert set(lengths[buffer.decided].tolist()) > {2, CHUNK}
    algorithm = PPO(policy, PPOConfig(value_iterations=0))
    chosen, _ = algorithm.add_targets(buffer)
    algorithm.add_reference(buffer, pipeline)
    rows = chosen.flatten().nonzero()[:, 0]
    batch = read_batch(buffer, rows, pipeline)
    loss, record = algorithm.losses(batch)
    assert record["ratio_error"].max() < 1e-3
    batch["raw_action"] = torch.where(batch["executed"], batch["raw_action"], 100.0)
    assert torch.allclose(algorithm.losses(batch)[0], loss)


def test_a_decision_is_worth_its_discounted_steps(
    rollout: tuple[Recorder, ChunkPolicy, RolloutBuffer],
) -> None:
    """The definition: δ = Σ_{i<n} γ^i r_i + γ^n V' − V, A = δ + λ γ^n A', decision after decision."""
    _, _, buffer = rollout
    found = generalised_advantages(
        buffer.reward.double(),
        buffer.value.double(),
        buffer.next_value.double(),
        buffer.terminated,
        buffer.truncated,
        0.9,
        0.8,
        buffer.decided,
    )
    for env in range(ENVS):
        following, advantage = STEPS, 0.0
        for step in reversed(buffer.decided[:, env].nonzero()[:, 0].tolist()):
            last = following - 1
            gains = sum(0.9**i * buffer.reward[step + i, env].item() for i in range(following - step))
            ahead = 0.0 if buffer.terminated[last, env] else buffer.next_value[last, env].item()
            connected = 0.0 if buffer.finished[last, env] else 0.8 * advantage
            discount = 0.9 ** (following - step)
            advantage = gains + discount * (ahead + connected) - buffer.value[step, env].item()
            assert found[step, env].item() == pytest.approx(advantage, abs=1e-6)
            following = step


def test_ppo_learns_in_chunks(pipeline: Pipeline) -> None:
    torch.manual_seed(0)
    policy = ChunkPolicy(3)
    env, buffer = Recorder(64), RolloutBuffer(15, 64, "cpu")
    algorithm = PPO(policy, PPOConfig(**FAST, **FREE))
    assert_it_learns(algorithm, env, buffer, pipeline, 40)
