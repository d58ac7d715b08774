"""Environments of LeRobot's own for RL, with PushT."""

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.envs.configs import EnvConfig, LiberoEnv, PushtEnv
from lerobot.processor import PolicyProcessorPipeline, UnnormalizerProcessorStep
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.policy_checks import learnt_range
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.envs.lerobot_env import (
    LeRobotTensorEnv,
    check_frame_rate,
    check_real_env,
    frame_limit,
    make_tensor_env,
)
from lerobot_wmrl.rl.compatibility import check_tasks
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.scripts.train import main
from tests.rl.checkpoints import save_untrained_policy

B, STEPS = 2, 3


@pytest.fixture
def env() -> LeRobotTensorEnv:
    made = make_tensor_env(PushtEnv(episode_length=STEPS), B, "cpu")
    assert isinstance(made, LeRobotTensorEnv)
    return made


def test_episodes_begin_anew_when_they_end(env: LeRobotTensorEnv) -> None:
    first, _ = env.reset(seed=5)
    assert first[OBS_IMAGE].shape == (B, 3, 96, 96)
    assert 0 <= first[OBS_IMAGE].min() <= first[OBS_IMAGE].max() <= 1
    assert first["task"] == ["", ""] or len(first["task"]) == B
    for _ in range(STEPS - 1):
        seen, reward, terminated, truncated, info = env.step(torch.full((B, 2), 250.0))
        assert reward.shape == (B,)
        assert not (terminated | truncated).any()
        assert "final_obs" not in info
    after, _, terminated, truncated, info = env.step(torch.full((B, 2), 250.0))
    assert (terminated | truncated).all()
    assert info["final_info"]["episode_length"].tolist() == [STEPS] * B
    assert not info["final_info"]["is_success"].any()
    moved = (info["final_obs"][OBS_STATE] - seen[OBS_STATE]).abs().max()
    begun = (after[OBS_STATE] - seen[OBS_STATE]).abs().max()
    assert moved < begun, "the last frame is near the one before, the new start is elsewhere"


def test_rewards_and_success_are_the_environments_own(
    env: LeRobotTensorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    (bare,) = PushtEnv(episode_length=STEPS).create_envs(1)["pusht"].values()
    env.reset(seed=5)
    bare.reset(seed=5)
    for target in (100.0, 400.0):
        given = np.full((1, 2), target, np.float32)
        expected = bare.step(given)[1]
        assert env.step(torch.from_numpy(given).repeat(B, 1))[1][0].item() == pytest.approx(expected[0])
    solved = env.envs[1].step

    def step(action: Any) -> tuple[Any, ...]:
        seen, _, _, _, info = solved(action)
        return seen, 7.0, True, False, {**info, "is_success": True}

    monkeypatch.setattr(env.envs[1], "step", step)
    env.reset(seed=5)
    _, reward, terminated, truncated, info = env.step(torch.full((B, 2), 250.0))
    assert reward[1] == 7
    assert terminated.tolist() == info["final_info"]["is_success"].tolist() == [False, True]
    assert not truncated.any()
    bare.close()


def test_another_frame_rate_than_that_of_the_data_is_refused() -> None:
    check_frame_rate(PushtEnv(), 10, "the dataset")
    with pytest.raises(FieldError, match=r"^real_env.fps=10: the dataset has 30 frames a second"):
        check_frame_rate(PushtEnv(), 30, "the dataset")


def test_seeds_decide_where_episodes_begin(env: LeRobotTensorEnv) -> None:
    first, _ = env.reset(seed=5)
    other, _ = env.reset(seed=[6, 5])
    assert torch.equal(first[OBS_STATE][0], other[OBS_STATE][1])
    assert torch.equal(first[OBS_STATE][1], other[OBS_STATE][0])


def test_later_episodes_are_the_same_again_too(
    env: LeRobotTensorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Aloha asks the operating system where to begin if it is given no seed."""
    unseeded = np.random.default_rng()
    for each in env.envs:
        reset = each.unwrapped.reset
        monkeypatch.setattr(
            each.unwrapped,
            "reset",
            lambda seed=None, reset=reset, **given: reset(
                seed=int(unseeded.integers(2**31)) if seed is None else seed, **given
            ),
        )
    begun = []
    for seed in (5, 5, 6):
        env.reset(seed=seed)
        begun.append([env.step(torch.full((B, 2), 250.0))[0][OBS_STATE] for _ in range(2 * STEPS)])
    for index in (STEPS - 1, 2 * STEPS - 1):
        first, again, other = (steps[index] for steps in begun)
        torch.testing.assert_close(again, first)
        assert not torch.allclose(other, first)


def test_actions_that_the_policy_has_learnt_are_not_clipped(
    env: LeRobotTensorEnv, caplog: pytest.LogCaptureFixture
) -> None:
    env.widen(torch.tensor([0.0, 100.0]), torch.tensor([512.0, 500.0]))
    assert not caplog.records
    stats = {ACTION: {"mean": [1.0, 1.0], "min": [-3.0, 0.0], "max": [500.0, 600.0]}}
    learnt = learnt_range(PolicyProcessorPipeline([UnnormalizerProcessorStep({}, {}, stats)]))
    assert learnt is not None
    env.widen(*learnt)
    assert "component 0 -3 to 500 (in the environment 0 to 512), component 1 0 to 600" in caplog.text
    env.reset(seed=5)
    *_, info = env.step(torch.tensor([[-3.0, 600.0], [-4.0, 0.0]]))
    assert info["reward_parts"]["clipped"].tolist() == [0, 0.5]


def test_actions_out_of_range_are_counted_and_nan_is_refused(env: LeRobotTensorEnv) -> None:
    env.reset(seed=5)
    info = env.step(torch.tensor([[250.0, 250.0], [600.0, 250.0]]))[-1]
    assert info["reward_parts"]["clipped"].tolist() == [0.0, 0.5]
    with pytest.raises(ValueError, match=r"NaN in environments \[1\]"):
        env.step(torch.tensor([[0.0, 0.0], [torch.nan, 0.0]]))


@EnvConfig.register_subclass("two_tasks")
@dataclass
class TwoTasks(PushtEnv):
    """PushT twice, the second time with longer episodes."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        lengths = (self.episode_length, 2 * self.episode_length)
        made = [PushtEnv(episode_length=length).create_envs(n_envs)["pusht"][0] for length in lengths]
        return {"pusht": dict(enumerate(made))}


class Counted(gym.Wrapper):
    """PushT whose starts depend on the number of resets, as LIBERO's do."""

    def __init__(self, env: gym.Env, first: int, stride: int) -> None:
        super().__init__(env)
        self.starts = itertools.count(first, stride)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(seed=next(self.starts), options=options)


@EnvConfig.register_subclass("unseeded")
@dataclass
class Unseeded(PushtEnv):
    """Of such environments."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        made = PushtEnv(episode_length=self.episode_length).create_envs(n_envs)
        vector = made["pusht"][0]
        vector.envs = [Counted(env, number, n_envs) for number, env in enumerate(vector.envs)]
        return made


def test_environments_begin_in_starts_of_their_own_where_resets_are_counted() -> None:
    states = LeRobotTensorEnv(Unseeded(episode_length=STEPS), B, "cpu").reset(seed=5)[0][OBS_STATE]
    known = LeRobotTensorEnv(PushtEnv(episode_length=STEPS), B, "cpu").reset(seed=[0, 1])[0][OBS_STATE]
    assert torch.equal(states, known)


@EnvConfig.register_subclass("counted_libero")
@dataclass
class CountedLibero(LiberoEnv):
    """PushT that says, as LIBERO's environments do, which starts it has."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        made = PushtEnv().create_envs(n_envs)
        for env in made["pusht"][0].envs:
            env._init_states = (0, 1, 2)
        return made


def test_more_starts_than_there_are_are_refused_before_anything_is_trained(tmp_path: Path) -> None:
    path = save_untrained_policy(tmp_path, OBS_IMAGE, size=96, actions=2)
    said = r"^real_env.init_states=True: counted_libero has 3 starts for a task, policies are measured on 4"
    with pytest.raises(FieldError, match=said):
        check_real_env(read_policy_config(str(path), []), CountedLibero(), 4)


class Endless(gym.Wrapper):
    """PushT that leaves it to LeRobot's rollout to end an episode, as LIBERO does."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = self.env.step(action)
        return observation, reward, terminated, False, info


@EnvConfig.register_subclass("endless")
@dataclass
class EndlessPusht(PushtEnv):
    """Of such environments."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        made = PushtEnv(episode_length=self.episode_length).create_envs(n_envs)
        made["pusht"][0].envs = [Endless(env) for env in made["pusht"][0].envs]
        return made


def test_an_episode_ends_at_the_limit_though_the_environment_goes_on() -> None:
    env = LeRobotTensorEnv(EndlessPusht(episode_length=STEPS), B, "cpu")
    env.reset(seed=5)
    *_, truncated, info = [env.step(torch.full((B, 2), 250.0)) for _ in range(STEPS)][-1]
    assert truncated.all()
    assert info["final_info"]["episode_length"].tolist() == [STEPS] * B


@EnvConfig.register_subclass("ten_tasks")
@dataclass
class TenTasks(PushtEnv):
    """PushT ten times; counts the environments that it has made."""

    made: ClassVar[int] = 0

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        TenTasks.made += 10 * n_envs
        config = PushtEnv(episode_length=self.episode_length)
        return {"pusht": {task: config.create_envs(n_envs)["pusht"][0] for task in range(10)}}


def test_hardly_more_environments_are_made_than_asked_for() -> None:
    env = LeRobotTensorEnv(TenTasks(episode_length=STEPS), 12, "cpu")
    assert (len(env.envs), env.tasks, TenTasks.made) == (12, 10, 10 + 20)
    assert len(set(map(id, env.envs))) == 12
    env.close()


def test_grpo_needs_starts_that_seeds_decide(env: LeRobotTensorEnv) -> None:
    grpo = TrainConfig(algorithm=GRPOConfig())
    check_tasks(grpo, env)
    unseeded = LeRobotTensorEnv(Unseeded(episode_length=STEPS), B, "cpu")
    check_tasks(TrainConfig(), unseeded)
    with pytest.raises(ValueError, match="a seed does not decide it; choose ppo"):
        check_tasks(grpo, unseeded)


def test_several_tasks_are_shared_out_and_the_longest_episode_counts() -> None:
    env = LeRobotTensorEnv(TwoTasks(episode_length=STEPS), 3, "cpu")
    limits = [each.get_wrapper_attr("_max_episode_steps") for each in env.envs]
    assert limits == [STEPS, 2 * STEPS, STEPS]
    assert env.max_episode_steps == frame_limit(TwoTasks(episode_length=STEPS)) == 2 * STEPS
    check_tasks(TrainConfig(), env)
    with pytest.raises(ValueError, match=r"^algorithm\.type=grpo: .*the environment has 2 tasks; choose one"):
        check_tasks(TrainConfig(algorithm=GRPOConfig()), env)
    env.close()
    single = LeRobotTensorEnv(TwoTasks(episode_length=STEPS), 1, "cpu")
    with pytest.raises(ValueError, match=r"^num_envs=1: .* 2 tasks.* set it to a multiple of 2"):
        check_tasks(TrainConfig(), single)
    single.close()


def test_ppo_trains_in_it_and_the_best_policy_is_selected_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=250.0)
    flags = [
        f"--policy.path={policy}",
        "--env.type=pusht",
        f"--env.episode_length={STEPS}",
        "--algorithm.type=ppo",
        "--algorithm.value_iterations=1",
        f"--num_envs={B}",
        "--iterations=1",
        "--selection.freq=1",
        "--selection.n_episodes=1",
        f"--output_dir={tmp_path / 'rl'}",
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *flags])
    main()
    line = read_metrics(tmp_path / "rl")[-1]
    assert (line["step"], line["episode_length"]) == (1, STEPS)
    assert (line["selection/real/k"], line["selection/real/n"]) == (0, 1)
    assert (tmp_path / "rl" / "checkpoints" / "best").exists()
    said = capfd.readouterr().err
    assert "the policy stays as it is, because the value function alone learns in the first 1" in said
