"""The training loop resumes bit by bit, and trains on seeds that no evaluation uses."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.seeds import first_seed
from lerobot_wmrl.rl.trainer import Schedule, train
from tests.rl.killed import Killed
from tests.rl.point_env import PointEnv

MakePolicy = Callable[..., CnnPolicy]


class FailingEnv(PointEnv):
    """Dies, or answers nonsense, from its `resets`-th reset on."""

    def __init__(
        self, num_envs: int, horizon: int, image_size: int = 0, *, resets: int, nonsense: bool = False
    ) -> None:
        super().__init__(num_envs, horizon, image_size)
        self.left, self.nonsense = resets, nonsense

    def reset(self, **kwargs: object) -> tuple[dict, dict]:
        self.left -= 1
        if self.left < 0 and not self.nonsense:
            raise Killed
        observation, info = super().reset(**kwargs)
        if self.left < 0:
            observation["observation.state"] += torch.nan
        return observation, info


class Unrewarded(PointEnv):
    """Pays nothing."""

    def step(self, actions: Tensor) -> Any:
        observation, reward, *rest = super().step(actions)
        return observation, 0 * reward, *rest


def run(
    policy: CnnPolicy, pipeline: Pipeline, output_dir: Path, env: PointEnv, train_encoder: bool = True
) -> PPO:
    """The trainer as the command calls it, from a fixed seed and the same initial policy."""
    output_dir.mkdir(exist_ok=True)
    torch.manual_seed(7)
    config = PPOConfig(
        value_iterations=1, value_normalisation=True, minibatch_size=32, train_encoder=train_encoder
    )
    algorithm = PPO(policy, config)
    buffer = RolloutBuffer(6, env.num_envs, "cpu")
    train(env, algorithm, pipeline, buffer, Schedule(4, 1, 0), output_dir, policy.save_pretrained)
    return algorithm


@pytest.mark.parametrize(("image_size", "train_encoder"), [(0, True), (32, False)])
def test_an_interrupted_training_ends_bit_by_bit_where_the_other_does(
    make_policy: MakePolicy, pipeline: Pipeline, tmp_path: Path, image_size: int, train_encoder: bool
) -> None:
    initial = make_policy(image_size).state_dict()

    def fresh() -> CnnPolicy:
        policy = make_policy(image_size)
        policy.load_state_dict(initial)
        return policy

    env = PointEnv(8, 6, image_size)
    whole = run(fresh(), pipeline, tmp_path / "whole", env, train_encoder)
    failing = FailingEnv(8, 6, image_size, resets=2)
    with pytest.raises(Killed):
        run(fresh(), pipeline, tmp_path / "cut", failing, train_encoder)
    torch.rand(5)
    resumed = run(fresh(), pipeline, tmp_path / "cut", env, train_encoder)
    for name, value in whole.policy.state_dict().items():
        assert torch.equal(resumed.policy.state_dict()[name], value), name
    for name, value in whole.reference.state_dict().items():
        assert torch.equal(resumed.reference.state_dict()[name], value), name
    timeless = [
        [
            {name: value for name, value in line.items() if not name.endswith("_s")}
            for line in read_metrics(folder)
        ]
        for folder in (tmp_path / "whole", tmp_path / "cut")
    ]
    assert timeless[0] == timeless[1]
    assert [line["step"] for line in timeless[0]] == [1, 2, 3, 4]


def test_not_a_number_stops_training_and_the_last_checkpoint_stays(
    make_policy: MakePolicy, pipeline: Pipeline, tmp_path: Path
) -> None:
    with pytest.raises(TrainingStopped, match="not finite"):
        run(make_policy(), pipeline, tmp_path, FailingEnv(8, 6, resets=2, nonsense=True))
    last = tmp_path / "checkpoints" / "last"
    assert last.resolve().name == "000002"
    weights = CnnPolicy.from_pretrained(last / "pretrained_model")
    assert all(value.isfinite().all() for name, value in weights.state_dict().items() if "target" not in name)


@pytest.mark.parametrize(("patience", "left"), [(1, None), (3, "000002")])
def test_a_training_that_is_stopped_leaves_what_it_has_trained(
    make_policy: MakePolicy, pipeline: Pipeline, tmp_path: Path, patience: int, left: str | None
) -> None:
    """Between two checkpoints, too; a policy that has not changed is not saved."""
    env, policy = Unrewarded(8, 6), make_policy()
    algorithm = PPO(policy, PPOConfig(patience=patience, value_iterations=0))
    schedule, buffer = Schedule(10, 10, 0), RolloutBuffer(6, env.num_envs, "cpu")
    further = f", and go on from here with `policy.path`={tmp_path}" if left else ""
    message = rf"no episode was rewarded in {patience} .*`output_dir`{re.escape(further)}$"
    with pytest.raises(TrainingStopped, match=message):
        train(env, algorithm, pipeline, buffer, schedule, tmp_path, policy.save_pretrained)
    last = tmp_path / "checkpoints" / "last"
    assert (last.resolve().name if last.exists() else None) == left
    if left:
        saved = CnnPolicy.from_pretrained(last / "pretrained_model").state_dict()
        assert all(torch.equal(value, saved[name]) for name, value in policy.state_dict().items())


def test_training_seeds_are_apart_from_evaluation_seeds() -> None:
    for seed, num_envs in ((0, 64), (900_000, 64), (EVALUATION_SEED - 3, 128)):
        for iteration in (0, 1, 77, 10_000):
            first = first_seed(seed, iteration, num_envs)
            assert first >= 0
            assert first + num_envs <= EVALUATION_SEED
    assert first_seed(5, 2, 64) != first_seed(5, 3, 64)


def test_trainings_of_neighbouring_seeds_begin_at_starts_of_their_own() -> None:
    """A thousand iterations each."""
    used = [{first_seed(seed, i, 64) + row for i in range(1000) for row in range(64)} for seed in range(5)]
    assert len(set().union(*used)) == 5 * 64_000
    assert first_seed(0, 3, 64) == 3 * 64
