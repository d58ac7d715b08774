"""Token ids as actions: kept as integers, a ratio each, and what common mistakes look like."""

from typing import Any

import pytest
import torch

from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.minibatches import read_batch
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from tests.rl.chunk_policy import ChunkPolicy
from tests.rl.conformance import check_samples_and_log_probs_agree
from tests.rl.conftest import point_policy
from tests.rl.learning import assert_it_learns
from tests.rl.point_env import PointEnv
from tests.rl.token_policy import BINS, FIRST_ID, TOKENS, TokenPolicy, to_metres

PIPELINE = Pipeline(prepare=lambda observation: observation, to_action=to_metres)


def rollout(policy: TokenPolicy, num_envs: int = 16) -> RolloutBuffer:
    buffer = RolloutBuffer(12, num_envs, "cpu")
    collect(PointEnv(num_envs, horizon=6), policy, PIPELINE, buffer, 0)
    return buffer


def test_integer_actions_survive_the_buffer() -> None:
    buffer = rollout(TokenPolicy())
    assert buffer.raw_action.dtype == torch.int64
    assert buffer.raw_action.shape == (12, 16, TOKENS)
    bins = buffer.raw_action - FIRST_ID
    assert set(bins.unique().tolist()) == set(range(BINS))
    batch = read_batch(buffer, torch.arange(192), PIPELINE)
    assert torch.equal(batch["raw_action"], buffer.raw_action.flatten(0, 1))


@pytest.mark.parametrize("ratio", ["action", "token"])
def test_before_the_first_update_every_ratio_is_one(ratio: str) -> None:
    torch.manual_seed(0)
    policy = TokenPolicy()
    buffer, algorithm = rollout(policy), PPO(policy, PPOConfig(value_iterations=0, ratio=ratio))
    algorithm.add_targets(buffer)
    algorithm.add_reference(buffer, PIPELINE)
    _, record = algorithm.losses(read_batch(buffer, torch.arange(192), PIPELINE))
    assert record["ratio_error"].max() < 1e-3


@pytest.mark.parametrize("ratio", ["action", "token"])
def test_ppo_learns_to_reach_by_tokens(ratio: str) -> None:
    torch.manual_seed(0)
    policy, buffer = TokenPolicy(), RolloutBuffer(15, 64, "cpu")
    settings: dict[str, Any] = {"policy_lr": 3e-3, "value_lr": 3e-3, "target_kl": 0.05, "minibatch_size": 240}
    algorithm = PPO(policy, PPOConfig(**settings, ratio=ratio, value_iterations=1, reference_coefficient=0.0))
    assert_it_learns(algorithm, PointEnv(64), buffer, PIPELINE, 30)


@pytest.mark.parametrize("policy", [TokenPolicy(), ChunkPolicy(3), point_policy()])
def test_samples_and_log_probs_are_of_one_distribution(policy: Any) -> None:
    check_samples_and_log_probs_agree(policy, {"observation.state": torch.rand(1, 4), "task": ["reach"]})


def test_a_temperature_that_only_sampling_knows_is_found() -> None:
    with pytest.raises(AssertionError):
        check_samples_and_log_probs_agree(
            TokenPolicy(temperature=0.7), {"observation.state": torch.rand(1, 4)}
        )


def test_rounded_log_probs_are_refused() -> None:
    with pytest.raises(ValueError, match=r"log-probabilities are torch\.bfloat16, .* in float32"):
        rollout(TokenPolicy(log_prob_dtype=torch.bfloat16))
