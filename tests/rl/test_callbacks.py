"""What is done between iterations is done once, survives a kill, and leaves the training's dice alone."""

import random
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.envs.configs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.seeds import (
    DYNA_SEEDS,
    EVALUATION_SEED,
    GATE_SEED,
    GATE_SEEDS,
    SELECTION_SEED,
    dyna_seed,
    gate_seed,
)
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.evaluation.policy_rollouts import evaluate_within
from lerobot_wmrl.rl.callbacks import Callback, Record
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.seeds import first_seed
from lerobot_wmrl.rl.selection import Selection
from lerobot_wmrl.rl.trainer import Schedule, train
from tests.rl.conftest import ACTION_SCALE
from tests.rl.killed import Killed
from tests.rl.point_env import PointEnv

MakePolicy = Callable[..., CnnPolicy]
ITERATIONS = 4


def roll() -> list[float]:
    """All dice there are."""
    return [torch.rand(1).item(), float(np.random.rand()), random.random()]  # noqa: NPY002


class Gambler:
    """Rolls all dice there are, at every second iteration up to the `last`; is killed, or stops the
    training, if told to."""

    name = "gambler"

    def __init__(self, killed_at: int | None = None, stops_at: int | None = None, last: int = 9) -> None:
        self.killed_at, self.stops_at, self.last = killed_at, stops_at, last
        self.runs: list[int] = []
        self.applied: list[list[int]] = []

    def due(self, iteration: int) -> bool:
        return iteration % 2 == 0 and iteration <= self.last

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        assert (checkpoint / "pretrained_model").is_dir()
        assert int(checkpoint.name) == iteration
        self.runs.append(iteration)
        rolled = roll()
        if iteration == self.killed_at:
            raise Killed
        return {"sum": sum(rolled), "nested": {"iteration": iteration}, "fine": True, "real_steps": 10}

    def apply(self, records: Mapping[int, Record]) -> None:
        self.applied.append(sorted(records))
        roll()
        if self.stops_at in records:
            raise TrainingStopped("enough")


def run(
    policy: CnnPolicy, pipeline: Pipeline, output_dir: Path, callbacks: Callable[[PointEnv], list[Callback]]
) -> CnnPolicy:
    """The trainer as the command calls it, with a checkpoint at the end and wherever a callback is due."""
    output_dir.mkdir(exist_ok=True)
    torch.manual_seed(7)
    env = PointEnv(8, horizon=6)
    algorithm = PPO(policy, PPOConfig(value_iterations=1, minibatch_size=32, policy_lr=1e-3))
    train(
        env,
        algorithm,
        pipeline,
        RolloutBuffer(6, 8, "cpu"),
        Schedule(ITERATIONS, 100, 0),
        output_dir,
        policy.save_pretrained,
        callbacks(env),
    )
    return algorithm.policy


@pytest.fixture
def fresh(make_policy: MakePolicy) -> Callable[[], CnnPolicy]:
    """The same untrained policy each time."""
    initial = make_policy().state_dict()

    def make() -> CnnPolicy:
        policy = make_policy()
        policy.load_state_dict(initial)
        return policy

    return make


def same(one: CnnPolicy, other: CnnPolicy) -> bool:
    return all(torch.equal(value, other.state_dict()[name]) for name, value in one.state_dict().items())


def select(output_dir: Path, policy: CnnPolicy, env: PointEnv) -> list[Callback]:
    """Real success of this policy in the training's own environment, every second iteration."""

    def scaled(action: torch.Tensor) -> torch.Tensor:
        return action * ACTION_SCALE

    loaded = LoadedPolicy(policy.config, policy, PolicyProcessorPipeline([]), scaled)
    config: EnvConfig = WmrlManiSkillEnv()
    measure = partial(evaluate_within, env, config, loaded, 5, SELECTION_SEED)
    return [Selection(2, ITERATIONS, {"real": measure}, output_dir)]


def test_a_training_with_callbacks_is_the_same_bit_by_bit(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    policy = fresh()
    plain = run(fresh(), pipeline, tmp_path / "plain", lambda env: [])
    selected = run(
        policy, pipeline, tmp_path / "on", lambda env: [*select(tmp_path / "on", policy, env), Gambler()]
    )
    assert same(plain, selected)
    assert not same(plain, fresh())


def test_a_training_killed_within_a_callback_ends_bit_by_bit_where_the_other_does(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    policies = [fresh() for _ in range(3)]

    def both(folder: Path, policy: CnnPolicy, gambler: Gambler) -> CnnPolicy:
        return run(policy, pipeline, folder, lambda env: [*select(folder, policy, env), gambler])

    uninterrupted = both(whole, policies[0], Gambler())
    with pytest.raises(Killed):
        both(cut, policies[1], Gambler(killed_at=2))
    torch.rand(5)
    gambler = Gambler()
    assert same(uninterrupted, both(cut, policies[2], gambler))
    assert gambler.runs == [2, 4], "what was found before the kill is not found again"
    assert gambler.applied == [[0], [0, 2], [0, 2, 4]]
    for name in ("selection", "gambler"):
        records = [
            sorted(path.relative_to(folder) for path in folder.glob(f"{name}/*/record.json"))
            for folder in (whole, cut)
        ]
        assert records[0] == records[1]
        assert len(records[0]) == 3
        assert all((whole / path).read_text() == (cut / path).read_text() for path in records[0])
    assert (whole / "checkpoints" / "best").resolve().name == (cut / "checkpoints" / "best").resolve().name
    timeless = [
        [
            {key: value for key, value in line.items() if not key.endswith("_s")}
            for line in read_metrics(folder)
        ]
        for folder in (whole, cut)
    ]
    assert timeless[0] == timeless[1]


def test_steps_in_reality_add_up_also_over_a_kill(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    with pytest.raises(Killed):
        run(fresh(), pipeline, tmp_path, lambda env: [Gambler(killed_at=4)])
    run(fresh(), pipeline, tmp_path, lambda env: [Gambler()])
    lines = read_metrics(tmp_path)
    assert [line["step"] for line in lines] == [0, 1, 2, 3, 4]
    assert [line["real_steps/gambler"] for line in lines] == [10, 10, 20, 20, 30]
    assert [line.get("gambler/nested/iteration") for line in lines] == [0, None, 2, None, 4]
    assert [line.get("env_steps") for line in lines] == [None, 48, 96, 144, 192]
    assert "gambler/fine" not in lines[0]


def test_conclusions_of_earlier_iterations_leave_a_resumed_training_s_dice_alone(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    """A world model that is loaded again rolls some."""
    whole = run(fresh(), pipeline, tmp_path / "whole", lambda env: [Gambler(last=0), Sleeper()])
    run(fresh(), pipeline, tmp_path / "cut", lambda env: [Gambler(last=0), Sleeper()])
    (tmp_path / "cut" / "checkpoints" / "000004").rename(tmp_path / "lost")
    assert same(whole, run(fresh(), pipeline, tmp_path / "cut", lambda env: [Gambler(last=0), Sleeper()]))


class Sleeper(Gambler):
    """Takes steps of its own."""

    name = "sleeper"


def test_a_resumed_callback_forgets_no_steps_of_another(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    """The first knows of iteration 2 when the second, which was killed there, has only been at 0."""
    with pytest.raises(Killed):
        run(fresh(), pipeline, tmp_path, lambda env: [Gambler(), Sleeper(killed_at=2)])
    run(fresh(), pipeline, tmp_path, lambda env: [Gambler(), Sleeper(last=0)])
    lines = read_metrics(tmp_path)
    assert [line["real_steps/gambler"] for line in lines] == [10, 10, 20, 20, 30]
    assert [line["real_steps/sleeper"] for line in lines] == [10] * 5


def test_what_was_found_in_iterations_that_are_repeated_is_found_again(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    run(fresh(), pipeline, tmp_path, lambda env: [Gambler()])
    (tmp_path / "checkpoints" / "000004").rename(tmp_path / "lost")
    gambler = Gambler()
    run(fresh(), pipeline, tmp_path, lambda env: [gambler])
    assert gambler.runs == [4]


def test_a_callback_stops_the_training_again_when_it_is_resumed(
    fresh: Callable[[], CnnPolicy], pipeline: Pipeline, tmp_path: Path
) -> None:
    gambler = Gambler(stops_at=2)
    for _ in range(2):
        with pytest.raises(TrainingStopped, match="enough"):
            run(fresh(), pipeline, tmp_path, lambda env: [gambler])
    assert gambler.runs == [0, 2]
    assert (tmp_path / "checkpoints" / "last").resolve().name == "000002"


def test_selection_gate_and_dyna_have_seeds_of_their_own() -> None:
    """Each from its first number to the next: training < Dyna's last < evaluation < selection < gate."""
    training = {first_seed(seed, i, 64) + 63 for seed in (0, 999_999) for i in (0, 9, 15_000, 15_624)}
    assert max(training) < EVALUATION_SEED
    assert EVALUATION_SEED < SELECTION_SEED < GATE_SEED
    places = (0, 50, 2_000_000, DYNA_SEEDS - 10, GATE_SEEDS - 10)
    for first_of, first, end in (
        (dyna_seed, EVALUATION_SEED - DYNA_SEEDS, EVALUATION_SEED),
        (gate_seed, GATE_SEED, GATE_SEED + GATE_SEEDS),
    ):
        firsts = [first_of(place, 50) for place in places]
        assert firsts[:2] == [first, first + 50]
        assert all(first <= seed <= end - 50 for seed in firsts)
