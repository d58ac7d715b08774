"""Policies compared on the same starts, in environments that LeRobot makes and evaluates."""

import json
import sys
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, LiberoEnv, PushtEnv
from lerobot.envs.utils import _LazyAsyncVectorEnv
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_policy_wm_mpc.modeling_wm_mpc import WmMpcPolicy
from lerobot_wmrl.common.checkpoints import link_checkpoint, resolved_name
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.lerobot_env import runs_in_processes
from lerobot_wmrl.evaluation import policy_rollouts
from lerobot_wmrl.evaluation.comparison import Comparison, Episode
from lerobot_wmrl.evaluation.policy_rollouts import opened
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.scripts.compare import CompareConfig, compare
from tests.rl.checkpoints import save_untrained_policy

TASKS = {"lift": (0, 1), "push": (0,)}


def difficulty(suite: str, task: int, seed: int) -> float:
    """What an action must exceed in that task's episode."""
    return float(np.random.default_rng([len(suite) + ord(suite[0]), task, seed]).random())


class ThresholdEnv(gym.Env):
    """An episode of one step succeeds if its action is above the difficulty of its seed."""

    metadata: ClassVar[dict[str, Any]] = {"render_fps": 10}
    observation_space = gym.spaces.Dict(
        {"pixels": gym.spaces.Dict({"third_view": gym.spaces.Box(0, 255, (32, 32, 3), np.uint8)})}
    )
    action_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    _max_episode_steps = 1
    task = task_description = "exceed it"

    def __init__(self, suite: str, number: int, harder: float) -> None:
        self.suite, self.number, self.harder = suite, number, harder

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        if seed is not None:
            self.threshold = difficulty(self.suite, self.number, seed) + self.harder
        return {"pixels": {"third_view": np.zeros((32, 32, 3), np.uint8)}}, {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        return self.reset()[0], 0.0, False, True, {"is_success": bool(action[0] > self.threshold)}


@EnvConfig.register_subclass("test_threshold")
@dataclass
class ThresholdConfig(EnvConfig):
    """Two suites of tasks, as LeRobot's benchmarks have them."""

    harder: float = 0.0
    suites: list[str] = field(default_factory=lambda: [*TASKS])
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {"action": PolicyFeature(FeatureType.ACTION, (3,))}
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        def make(suite: str, task: int) -> Any:
            copies = [partial(ThresholdEnv, suite, task, self.harder)] * n_envs
            if use_async_envs:
                return _LazyAsyncVectorEnv(copies)
            return SyncVectorEnv(copies, autoreset_mode=AutoresetMode.SAME_STEP)

        return {suite: {task: make(suite, task) for task in TASKS[suite]} for suite in self.suites}


class CountingEnv(ThresholdEnv):
    """Takes its starts in turn, whatever the seed, and ends in the second step unless it succeeds before."""

    _max_episode_steps = 2
    _init_states = (*range(12),)

    def __init__(self, first: int, stride: int) -> None:
        super().__init__("push", 0, 0.0)
        self.starts = count(first, stride)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.steps = 0
        return super().reset(seed=next(self.starts))

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.steps += 1
        success = bool(action[0] > self.threshold)
        seen = {"pixels": {"third_view": np.zeros((32, 32, 3), np.uint8)}}
        return seen, 0.0, success, self.steps == 2, {"is_success": success}


@EnvConfig.register_subclass("test_counting")
@dataclass
class CountingConfig(LiberoEnv):
    """A task whose starts are chosen as LIBERO's are."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        return {"push": {0: SyncVectorEnv([partial(CountingEnv, row, n_envs) for row in range(n_envs)])}}


@pytest.mark.parametrize("killed", [False, True])
def test_policies_meet_the_same_starts_where_resets_choose_them(config, killed, monkeypatch):
    """One policy's episodes end sooner, the comparison is interrupted, and no start comes twice."""
    monkeypatch.setattr(
        policy_rollouts, "make_env_pre_post_processors", lambda *_: [PolicyProcessorPipeline(steps=[])] * 2
    )
    config.policies, config.env, config.n_episodes = config.policies[:2], CountingConfig(), 12
    config.stop_early = False
    if killed:
        kill_in_third_block(config, monkeypatch)
    episodes = results_of(config)["episodes"]
    expected = [[rate > difficulty("push", 0, start) for rate in (0.6, 0.9)] for start in range(12)]
    assert [episode["successes"] for episode in episodes] == expected
    with pytest.raises(
        ValueError, match=r"n_episodes=13: test_counting has 12 starts for a task, .* at most 12"
    ):
        compare(replace(config, n_episodes=13, output_dir=config.output_dir / "more"))


def test_no_start_comes_twice_after_a_call_that_ended_within_a_batch(config, monkeypatch):
    monkeypatch.setattr(
        policy_rollouts, "make_env_pre_post_processors", lambda *_: [PolicyProcessorPipeline(steps=[])] * 2
    )
    config.policies, config.env = config.policies[:2], CountingConfig()
    assert len(results_of(replace(config, n_episodes=6))["episodes"]) == 6
    with pytest.raises(ValueError, match=r"n_episodes=12: the 6 starts so far end within a batch of 4"):
        compare(replace(config, n_episodes=12))


@pytest.fixture
def config(tmp_path: Path) -> CompareConfig:
    """Three policies with success rates of 60, 90 and 60 %; the first and the last are equal."""
    policies = [
        str(save_untrained_policy(tmp_path / name, constant=rate))
        for name, rate in {"fair": 0.6, "good": 0.9, "twin": 0.6}.items()
    ]
    return CompareConfig(
        policies=policies, env=ThresholdConfig(), n_episodes=60, batch_size=4, output_dir=tmp_path / "out"
    )


@pytest.fixture
def imagination(small_dataset: Any, trained_models: dict[str, Path]) -> WorldModelEnv:
    return WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        device="cpu",
        episode_length=2,
        dataset=StartFrames(root=str(small_dataset.root)),
        reward=GeneralConfig(alpha=1.0),
        done_threshold=0.0001,
        done_frames=1,
    )


def results_of(config: CompareConfig) -> dict[str, Any]:
    compare(config)
    return json.loads((config.output_dir / "comparison.json").read_text())


def test_a_clear_difference_stops_early_and_every_outcome_is_of_its_task_and_seed(config, capsys):
    config.policies = config.policies[:2]
    found = results_of(config)
    episodes = [Episode(**episode) for episode in found["episodes"]]
    assert found["finished"]
    assert not found["complete"]
    assert 0 < len(episodes) < 60 * 3
    assert len(episodes) % (config.batch_size * 3) == 0
    for suite, task, seed, successes in episodes:
        assert successes == [rate > difficulty(suite, task, seed) for rate in (0.6, 0.9)]
    last = EVALUATION_SEED + len(episodes) // 3
    starts = {
        (suite, task, seed)
        for suite, tasks in TASKS.items()
        for task in tasks
        for seed in range(EVALUATION_SEED, last)
    }
    assert {episode[:3] for episode in episodes} == starts
    (pair,) = found["pairs"]
    fair, good = config.policies
    assert (pair["better"], pair["test"], pair["lost"]) == (good, "sequential", 0)
    assert pair["p_value"] == pytest.approx((pair["gained"] + 1) / 2 ** pair["gained"])
    assert pair["mcnemar_p_value"] == pytest.approx(2 / 2 ** pair["gained"])
    assert pair["gained"] == found["policies"][good]["k"] - found["policies"][fair]["k"]
    said = capsys.readouterr().out
    assert f"{good} succeeds more often than {fair}" in said
    assert "p is valid at any time of stopping; p up to 0.05 decides" in said
    assert (config.output_dir / "comparison.png").is_file()


def test_equal_policies_are_not_decided_after_all_starts(config, capsys):
    config.policies, config.n_episodes = config.policies[::2], 6
    found = results_of(config)
    assert found["pairs"][0]["better"] is None
    assert len(found["episodes"]) == 6 * 3
    assert "0 gained, 0 lost, p = 1: not decided after 18 starts" in capsys.readouterr().out


@pytest.mark.parametrize("stop", ["killed", "too few"])
def test_a_comparison_that_stopped_continues_to_the_same_result(config, stop, tmp_path, monkeypatch):
    """Bit for bit, though the policies draw their actions."""
    monkeypatch.setattr(CnnPolicy, "select_action", lambda self, batch: torch.rand(4, 3))
    config.policies = [str(save_untrained_policy(tmp_path / name)) for name in ("one", "another")]
    config.n_episodes = 16
    whole = results_of(replace(config, output_dir=tmp_path / "whole"))
    if stop == "killed":
        kill_in_third_block(config, monkeypatch)
    else:
        compare(replace(config, n_episodes=8))
    assert len(json.loads((config.output_dir / "comparison.json").read_text())["episodes"]) == 8 * 3
    assert results_of(config) == whole
    assert {True, False} == {success for episode in whole["episodes"] for success in episode["successes"]}


def test_a_comparison_that_stopped_ends_with_fewer_starts(config, monkeypatch):
    """Its file says so too, though nothing is left to run."""
    config.policies, config.n_episodes = config.policies[::2], 16
    kill_in_third_block(config, monkeypatch)
    assert not json.loads((config.output_dir / "comparison.json").read_text())["complete"]
    config.n_episodes = 8
    assert results_of(config)["complete"]


def test_what_another_command_has_run_meanwhile_is_kept(config, monkeypatch):
    """It ended while this one made its environments."""
    whole = compare(replace(config)) or results_of(config)
    results = config.output_dir / "comparison.json"
    finished = results.read_text()
    results.unlink()
    make = policy_rollouts.opened

    def opened(*args: Any) -> Any:
        results.write_text(finished)
        return make(*args)

    monkeypatch.setattr("lerobot_wmrl.scripts.compare.opened", opened)
    monkeypatch.setattr(policy_rollouts, "run_block", None)
    compare(config)
    assert results_of(config) == whole


def kill_in_third_block(config: CompareConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupt a comparison after two blocks."""
    run_block, blocks = policy_rollouts.run_block, []

    def killed(*args: Any) -> list[Episode]:
        blocks.append(args)
        if len(blocks) == 3:
            raise KeyboardInterrupt
        return run_block(*args)

    monkeypatch.setattr(policy_rollouts, "run_block", killed)
    with pytest.raises(KeyboardInterrupt):
        compare(config)
    monkeypatch.setattr(policy_rollouts, "run_block", run_block)


def test_a_finished_comparison_makes_no_environment_again(config, monkeypatch):
    config.n_episodes = 4
    first = results_of(config)
    monkeypatch.setattr(ThresholdConfig, "create_envs", None)
    assert results_of(config) == first


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"env": ThresholdConfig(harder=0.1)}, "env.harder 0.0 → 0.1"),
        ({"seed": 7}, "seed 1000000 → 7"),
        ({"stop_early": False}, "stop_early True → False"),
    ],
)
def test_results_of_other_settings_are_not_mixed(config, changed, message):
    config.n_episodes = 4
    before = results_of(config)
    with pytest.raises(ValueError, match=message):
        compare(replace(config, **changed))
    assert json.loads((config.output_dir / "comparison.json").read_text()) == before


def test_another_policy_of_the_same_name_is_not_mixed_with_the_first(config):
    config.n_episodes = 4
    results_of(config)
    save_untrained_policy(Path(config.policies[1]), actions=3, constant=0.9)
    with pytest.raises(ValueError, match=f"another content of {config.policies[1]}, under the same name"):
        compare(replace(config, n_episodes=8))


def test_with_mcnemars_test_the_number_of_starts_is_fixed(config):
    config.stop_early, config.n_episodes = False, 4
    results_of(config)
    with pytest.raises(ValueError, match="n_episodes 4 → 8"):
        compare(replace(config, n_episodes=8))


def test_mcnemars_test_decides_when_all_starts_are_there() -> None:
    episodes = [Episode("suite", 0, seed, [False, True]) for seed in range(10)]
    (waiting,) = Comparison("ab", 11, stop_early=False, episodes=episodes).pairs()
    (decided,) = Comparison("ab", 10, stop_early=False, episodes=episodes).pairs()
    assert (waiting.better, decided.better) == (None, "b")
    assert decided.p_value == pytest.approx(2 / 2**10)


def test_each_task_has_rates_of_its_own() -> None:
    episodes = [Episode("lift", task, seed, [task == 0, seed > 0]) for task in (0, 3) for seed in range(4)]
    compared = Comparison("ab", 4, episodes=episodes)
    found = {
        task: {name: rate.k for name, rate in own.items()} for task, own in compared.rates_by_task().items()
    }
    assert found == {"lift 0": {"a": 4, "b": 3}, "lift 3": {"a": 0, "b": 3}}
    assert compared.as_json()["by_task"]["lift 3"]["b"] == Proportion(3, 4).as_json()
    lines = str(compared).splitlines()
    assert [line.split("  ")[0] for line in lines[:6]] == [
        "a",
        "b",
        "a, lift 0",
        "b, lift 0",
        "a, lift 3",
        "b, lift 3",
    ]
    assert "lift" not in str(Comparison("ab", 4, episodes=episodes[:4]))


@pytest.mark.parametrize(("against", "pairs"), [("first", ["ab", "ac"]), ("all", ["ab", "ac", "bc"])])
def test_pairs_share_alpha(against: str, pairs: list[str]) -> None:
    found = Comparison("abc", 10, against, alpha=0.06).pairs()
    assert [pair.before + pair.after for pair in found] == pairs
    assert {pair.level for pair in found} == {0.06 / len(pairs)}


def test_a_link_to_a_checkpoint_names_the_checkpoint(tmp_path, monkeypatch):
    """`last` moves on as a training continues: the episodes of two checkpoints must not be mixed."""
    monkeypatch.chdir(tmp_path)
    for step in ("000010", "000020"):
        folder = Path("run/checkpoints", step)
        save_untrained_policy(folder / "pretrained_model")
        link_checkpoint(folder, "last")
        for given in ("run", "run/checkpoints/last", "run/checkpoints/last/pretrained_model"):
            assert resolved_name(given) == str(folder)
    assert resolved_name("lerobot/pusht") == "lerobot/pusht"


def test_a_world_model_compares_a_policy_with_a_planner(imagination, tmp_path):
    """From each of its six start frames once: a threshold that every frame reaches makes all succeed."""
    planner = tmp_path / "planner"
    settings = WmMpcConfig(
        world_model_path=imagination.world_model_path,
        device="cpu",
        horizon=4,
        execute=2,
        samples=4,
        elites=2,
        iterations=1,
        knots=2,
    )
    WmMpcPolicy(settings).save_pretrained(planner)
    for processor in make_pre_post_processors(settings):
        processor.save_pretrained(planner)
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    config = CompareConfig(
        policies=[str(policy), str(planner)], env=imagination, n_episodes=7, output_dir=tmp_path / "out"
    )
    fewer = replace(imagination, dataset=replace(imagination.dataset, max_starts=4))
    for env, starts, setting in ((imagination, 6, "of them"), (fewer, 4, "with `env.dataset.max_starts`")):
        message = rf"n_episodes=7: .* has {starts} start frames .* at most {starts}, or give more {setting}"
        with pytest.raises(ValueError, match=message):
            compare(replace(config, env=env))
    assert not config.output_dir.exists()
    found = results_of(replace(config, n_episodes=6))
    assert [rate["k"] for rate in found["policies"].values()] == [6, 6]
    assert found["env"]["type"] == "world_model"


@pytest.mark.parametrize(
    ("saved", "message"),
    [
        ({"actions": 3}, "has 3 action components, the environment 7"),
        ({"actions": 7, "camera": "wrist"}, "needs observation.images.wrist, which the environment does not"),
        ({"actions": 7, "size": 16}, r"of shape \(3, 16, 16\), the environment has \(3, 32, 32\)"),
    ],
)
def test_a_policy_must_fit_the_environment(imagination, saved, message, tmp_path):
    fits, other = (
        str(save_untrained_policy(tmp_path / name, **shapes))
        for name, shapes in {"fits": {"actions": 7}, "other": saved}.items()
    )
    config = CompareConfig([fits, other], imagination, n_episodes=6, output_dir=tmp_path / "out")
    with pytest.raises(ValueError, match=f"policies={other}: .*{message}"):
        compare(config)
    assert not config.output_dir.exists()


def test_a_policy_in_other_units_than_the_world_model_is_refused(imagination, tmp_path):
    """Of its actions, each would be a corner of the range."""
    policy, other = (
        str(save_untrained_policy(tmp_path / name, actions=7, constant=mean))
        for name, mean in {"degrees": 1000.0, "fits": 0.0}.items()
    )
    config = CompareConfig([policy, other], imagination, n_episodes=6, output_dir=tmp_path / "out")
    with pytest.raises(
        ValueError, match=rf"policies={policy}: .*was trained on actions .* is 1000 on average"
    ):
        compare(config)
    assert not config.output_dir.exists()


def test_policies_are_compared_in_maniskill(tmp_path, caplog):
    """Success by scene is not logged: the table counts every seed once, whichever policy ran from it."""
    policies = [str(save_untrained_policy(tmp_path / name, actions=7, constant=0.0)) for name in "ab"]
    env = WmrlManiSkillEnv(image_size=32, episode_length=2, scenes=[0])
    found = results_of(CompareConfig(policies, env, n_episodes=2, batch_size=1, output_dir=tmp_path / "out"))
    assert [episode["successes"] for episode in found["episodes"]] == [[False, False]] * 2
    assert "by scene" not in caplog.text


def test_a_single_task_of_a_benchmark_runs_in_processes_to_the_same_result(config, monkeypatch):
    """That of several tasks, whose processes would all be open at once, runs in this one."""
    reset, parallel = _LazyAsyncVectorEnv.reset, []

    def noted(env: Any, **given: Any) -> Any:
        parallel.append(env.num_envs)
        return reset(env, **given)

    monkeypatch.setattr(_LazyAsyncVectorEnv, "reset", noted)
    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # a new process cannot import a test
    config.policies, config.n_episodes, config.batch_size = config.policies[:2], 4, 2
    several = results_of(config)
    assert not parallel
    config.env, config.output_dir = ThresholdConfig(suites=["push"]), config.output_dir / "alone"
    alone = results_of(config)
    assert parallel == [2] * 4, "two policies, two batches"
    assert alone["episodes"] == [each for each in several["episodes"] if each["suite"] == "push"]


def test_environments_of_other_packages_stay_in_this_process() -> None:
    assert not runs_in_processes(PushtEnv())


def test_each_policy_has_environments_of_its_own_where_resets_may_be_counted(imagination: WorldModelEnv):
    with opened(PushtEnv(episode_length=2), 1, False, policies=2) as (first, second):
        assert first["pusht"][0] is not second["pusht"][0]
    with opened(imagination, 1, False, policies=2) as (first, second):
        assert first is second


def test_no_table_by_scene_is_shown_for_several_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would have the outcomes of the first one; tensor environments keep it behind their adapter."""
    kept = SimpleNamespace(results=SimpleNamespace(episodes={"start": True}))
    left = []
    made = {"push": {0: SimpleNamespace(env=kept)}}
    monkeypatch.setattr(policy_rollouts, "make_env", lambda *_, **__: made)
    monkeypatch.setattr(policy_rollouts, "close_envs", lambda envs: left.append(dict(kept.results.episodes)))
    with opened(WmrlManiSkillEnv(), 1, False, 2):
        pass
    assert left == [{}]
