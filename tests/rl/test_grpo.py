"""GRPO: groups begin alike, only what they tell apart is learnt from, and that is enough."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.grpo import GRPO
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from lerobot_wmrl.rl.seeds import start_seeds
from lerobot_wmrl.rl.trainer import Schedule, train
from tests.rl.learning import assert_it_learns, update
from tests.rl.point_env import PointEnv

MakePolicy = Callable[..., CnnPolicy]
GROUP, ENVS, STEPS = 8, 64, 15


def one_rollout(
    policy: CnnPolicy, pipeline: Pipeline, steps: int = STEPS, **config: Any
) -> tuple[GRPO, RolloutBuffer]:
    algorithm = GRPO(policy, GRPOConfig(group_size=GROUP, **config))
    buffer = RolloutBuffer(steps, ENVS, "cpu")
    collect(PointEnv(ENVS), policy, pipeline, buffer, 5, algorithm.group_size)
    return algorithm, buffer


def test_the_seeds_of_a_group_are_one_and_no_evaluation_s() -> None:
    seeds = start_seeds(64, ENVS, GROUP)
    assert isinstance(seeds, list)
    groups = torch.tensor(seeds).view(-1, GROUP)
    assert (groups == groups[:, :1]).all()
    assert len(groups[:, 0].unique()) == ENVS // GROUP
    assert groups.max() < EVALUATION_SEED
    assert seeds == start_seeds(64, ENVS, GROUP) != start_seeds(128, ENVS, GROUP)
    assert start_seeds(64, ENVS, 1) == 64


def test_a_group_begins_alike_and_then_parts(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    _, buffer = one_rollout(make_policy(), pipeline)
    states = buffer.observations.tensors["observation.state"].view(STEPS, -1, GROUP, 4)
    assert (states[0] == states[0][:, :1]).all()
    assert not torch.equal(states[0][0, 0], states[0][1, 0])
    assert (states[1][:, 1:] != states[1][:, :1]).any(dim=-1).all()


def test_first_episodes_of_groups_with_a_signal_are_learnt_from(
    make_policy: MakePolicy, pipeline: Pipeline
) -> None:
    """Episodes last at most 15 of 40 steps; the advantage of each step is its episode's."""
    algorithm, buffer = one_rollout(make_policy(), pipeline, steps=40, least_group_std=0.3)
    chosen, numbers = algorithm.add_targets(buffer)
    for env in range(ENVS):
        length = int(buffer.finished[:, env].nonzero()[0]) + 1
        assert chosen[:, env].sum() in (0, length)
        assert not chosen[length:, env].any()
    by_group = chosen[0].view(-1, GROUP)
    assert (by_group == by_group[:, :1]).all()
    assert 0 < numbers["groups_with_signal"] < 1
    assert numbers["groups_with_signal"] == pytest.approx(by_group[:, 0].float().mean())
    advantage = buffer.columns["advantage"]
    assert (advantage == advantage[0]).all()
    returns = (buffer.reward * buffer.first_episode).sum(0).view(-1, GROUP)
    best = returns.argmax(1)
    assert (advantage[0].view(-1, GROUP)[by_group[:, 0]].argmax(1) == best[by_group[:, 0]]).all()


def test_without_a_signal_nothing_is_learnt(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    before = copy.deepcopy(policy.state_dict())
    algorithm, buffer = one_rollout(policy, pipeline, least_group_std=1e3)
    logged = update(algorithm, buffer, pipeline).to_log_dict()
    assert logged["updates"] == logged["groups_with_signal"] == logged["reference_kl"] == 0
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())
    assert algorithm.iteration == 1


def test_an_iteration_without_a_signal_is_logged_as_any(
    make_policy: MakePolicy, pipeline: Pipeline, tmp_path: Path
) -> None:
    """There is no update, so none of its metrics."""
    policy = make_policy()
    algorithm = GRPO(policy, GRPOConfig(group_size=GROUP, least_group_std=1e3))
    buffer, schedule = RolloutBuffer(3, ENVS, "cpu"), Schedule(2, 2, 0)
    train(PointEnv(ENVS), algorithm, pipeline, buffer, schedule, tmp_path, policy.save_pretrained)
    assert [line["updates"] for line in read_metrics(tmp_path)] == [0, 0]


def test_a_training_without_a_signal_stops(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    """Rewards that differ by less than `least_group_std` are none to it."""
    algorithm = GRPO(make_policy(), GRPOConfig(group_size=GROUP, least_group_std=1e3, patience=2))
    buffer = RolloutBuffer(STEPS, ENVS, "cpu")
    algorithm.iterate(PointEnv(ENVS), pipeline, buffer, seed=0, last=False)
    assert buffer.reward.any()
    with pytest.raises(
        TrainingStopped,
        match=r"in no group did returns differ by .*in 2 iterations",
    ):
        algorithm.iterate(PointEnv(ENVS), pipeline, buffer, seed=0, last=False)


def test_the_value_is_not_touched(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    before = copy.deepcopy(policy.state_dict())
    algorithm, buffer = one_rollout(policy, pipeline)
    assert update(algorithm, buffer, pipeline).extra["updates"] > 0
    changed = {
        name.split(".")[0]
        for name, value in policy.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"encoder", "actor", "std_logit"}


def test_a_kept_encoder_is_not_touched_either(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy(32)
    before = copy.deepcopy(policy.state_dict())
    algorithm = GRPO(policy, GRPOConfig(group_size=GROUP, train_encoder=False, policy_lr=1e-3))
    env, buffer = PointEnv(16, horizon=6, image_size=32), RolloutBuffer(12, 16, "cpu")
    stats = algorithm.iterate(env, pipeline, buffer, seed=0, last=False)
    assert stats["updates"] > 0
    assert stats["first_ratio_error"] < 1e-3
    changed = {
        name.split(".")[0]
        for name, value in policy.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"actor", "std_logit"}


def test_the_clip_is_asymmetric(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    """Ratios at 1.25 are still free, those at 0.75 are not."""
    policy = make_policy()
    algorithm, buffer = one_rollout(policy, pipeline)
    algorithm.add_targets(buffer)
    algorithm.add_reference(buffer, pipeline)
    for ratio, outside in ((1.25, 0.0), (1.3, 1.0), (0.85, 0.0), (0.75, 1.0)):
        shifted = buffer.log_prob.clone()
        shifted[..., 0] -= torch.tensor(ratio).log()
        batch = {
            "observation": buffer.observations.read(torch.arange(9)),
            "raw_action": buffer.raw_action[0, :9],
        }
        columns = {name: column[0, :9] for name, column in buffer.columns.items()}
        _, record = algorithm.losses({**batch, **columns, "log_prob": shifted[0, :9]})
        assert record["clip_fraction"].tolist() == [outside] * 9


def test_grpo_learns_to_reach(make_policy: MakePolicy, pipeline: Pipeline) -> None:
    policy = make_policy()
    env, buffer = PointEnv(ENVS), RolloutBuffer(STEPS, ENVS, "cpu")
    settings = {"policy_lr": 3e-3, "target_kl": 0.05, "minibatch_size": 240, "max_reference_kl": 1e9}
    algorithm = GRPO(policy, GRPOConfig(group_size=GROUP, **settings))
    assert_it_learns(algorithm, env, buffer, pipeline, 30)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"group_size": 1}, r"group_size=1"),
        ({"clip_high": 0.0}, r"clip_high=0\.0"),
        ({"least_group_std": 0.0}, r"least_group_std=0\.0"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GRPOConfig(**settings)
