"""ManiSkill through LeRobot's and through the trainer's eyes."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
import torch
from lerobot.envs import close_envs
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation

from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.maniskill_env import ManiSkillEnv, ManiSkillTensorEnv
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.tasks import TASKS
from lerobot_wmrl.rewards.general import RuleBasedReward, default_discount

HORIZON = 3
STAY = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)


@pytest.fixture(scope="module")
def env() -> Iterator[ManiSkillEnv]:
    env = ManiSkillEnv(
        WmrlManiSkillEnv(episode_length=HORIZON, cameras=["third_view", "wrist"], image_size=64)
    )
    yield env
    env.close()


def test_observations_lie_in_their_space_and_the_seed_decides_them(env: ManiSkillEnv) -> None:
    first, info = env.reset(seed=EVALUATION_SEED)
    assert env.observation_space.contains(first)
    again, _ = env.reset(seed=EVALUATION_SEED)
    assert np.array_equal(first["pixels"]["wrist"], again["pixels"]["wrist"])
    assert info["seed"] == EVALUATION_SEED
    _, following = env.reset(seed=EVALUATION_SEED + 1)
    assert following["scene"] != info["scene"]


def test_the_wrist_camera_sees_something_else_than_the_third_view(env: ManiSkillEnv) -> None:
    pixels = env.reset(seed=0)[0]["pixels"]
    assert np.abs(pixels["wrist"].astype(int) - pixels["third_view"]).mean() > 5
    assert pixels["wrist"].std() > 5


def test_an_episode_is_truncated_at_the_horizon_not_terminated(env: ManiSkillEnv) -> None:
    env.reset(seed=1)
    ends = [env.step(STAY)[2:4] for _ in range(HORIZON)]
    assert ends == [(False, False)] * (HORIZON - 1) + [(False, True)]


def test_a_step_pays_for_the_progress_that_it_made(
    env: ManiSkillEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    down = np.array([0.0, 0, -1, 0, 0, 0, -1], np.float32)
    earned = []
    for reward in (RuleBasedReward(alpha=0.0, form="absolute"), RuleBasedReward()):
        monkeypatch.setattr(env.config, "reward", reward)
        env.reset(seed=0)
        earned.append([env.step(down)[1] for _ in range(3)])
    progress, paid = earned
    expected = [0.1 * (default_discount(HORIZON) * now - before) for before, now in pairwise(progress)]
    assert progress[0] != progress[-1]
    assert paid[1:] == pytest.approx(expected, abs=1e-5)


def test_a_reset_without_a_seed_draws_a_training_seed(env: ManiSkillEnv) -> None:
    env.reset(seed=EVALUATION_SEED)
    assert all(env.reset()[1]["seed"] < EVALUATION_SEED for _ in range(3))


def test_lerobot_gets_what_a_policy_is_trained_on() -> None:
    config = WmrlManiSkillEnv(episode_length=HORIZON, image_size=64)
    envs = config.create_envs(1)["push"][0]
    try:
        observation, _ = envs.reset(seed=[7], options={NEW_ROLLOUT_OPTION: True})
        batch = preprocess_observation(observation)
        assert batch["observation.images.third_view"].shape == (1, 3, 64, 64)
        assert batch["observation.state"].shape == (1, 8)
        assert set(batch) <= set(config.features_map.values()) | {"task"}
        assert envs.call("_max_episode_steps") == (HORIZON,)
        assert "push" in envs.call("task_description")[0] or "pushing" in envs.call("task_description")[0]
        for _ in range(HORIZON):
            *_, truncated, info = envs.step(STAY[None])
        assert truncated.all()
        assert not info["final_info"]["is_success"].any()
    finally:
        envs.close()


@pytest.fixture(scope="module")
def tensor_env() -> Iterator[ManiSkillTensorEnv]:
    env = ManiSkillTensorEnv(WmrlManiSkillEnv(episode_length=HORIZON, image_size=64), 1, "cpu")
    yield env
    env.close()


def test_a_sub_environment_begins_where_its_seed_in_the_list_says(tensor_env: ManiSkillTensorEnv) -> None:
    """So several that have one seed begin alike; one of them is enough to see it."""
    first, again, other = (tensor_env.reset(seed=[seed])[0] for seed in (5, 5, 6))
    for name in ("observation.images.third_view", "observation.state"):
        assert torch.equal(first[name], again[name])
        assert not torch.equal(first[name], other[name])


def test_the_tensor_environment_keeps_the_last_observation_of_an_episode(
    tensor_env: ManiSkillTensorEnv,
) -> None:
    env = tensor_env
    observation, _ = env.reset(seed=[0])
    arrays = {name: value.numpy() for name, value in observation.items() if name != "task"}
    assert env.observation_space.contains(arrays)
    assert observation["observation.images.third_view"].shape == (1, 3, 64, 64)
    assert observation["observation.images.third_view"].min() >= 0.0
    assert observation["observation.images.third_view"].max() <= 1.0
    raise_gripper = torch.tensor([[0.0, 0.0, 0.05, 0.0, 0.0, 0.0, -1.0]])
    for step in range(HORIZON):
        observation, reward, terminated, truncated, info = env.step(raise_gripper)
        assert ("final_obs" in info) == (step == HORIZON - 1)
        assert info["reward_parts"]["clipped"].tolist() == [0]
    *_, beyond = env.step(torch.tensor([[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]]))
    assert beyond["reward_parts"]["clipped"].tolist() == pytest.approx([1 / 7])
    with pytest.raises(ValueError, match=r"NaN in environments \[0\]"):
        env.step(torch.full((1, 7), torch.nan))
    with pytest.raises(ValueError, match=r"shape \(1, 6\), but 1 environments take \(1, 7\)"):
        env.step(torch.zeros(1, 6))
    assert reward.dtype == torch.float32
    assert truncated.all()
    assert not terminated.any()
    assert info["final_info"]["episode_length"].tolist() == [HORIZON]
    assert not info["final_info"]["is_success"].any()
    final = info["final_obs"]["observation.state"]
    assert not torch.allclose(final, observation["observation.state"], atol=1e-3)
    assert len(info["final_obs"]["task"]) == 1


def test_lerobot_gets_an_environment_of_each_task() -> None:
    made = WmrlManiSkillEnv(task="pull, push").create_envs(1)
    try:
        assert {suite: envs[0].call("task") for suite, envs in made.items()} == {
            "pull": ("pull",),
            "push": ("push",),
        }
        lengths = [envs[0].call("_max_episode_steps")[0] for envs in made.values()]
        assert lengths == [TASKS["pull"].horizon, TASKS["push"].horizon]
    finally:
        close_envs(made)


def test_tasks_are_shared_out_among_the_environments_of_the_trainer() -> None:
    env = ManiSkillTensorEnv(WmrlManiSkillEnv(task="push,pick_place", image_size=32), 3, "cpu")
    try:
        assert env.envs.call("task") == ("push", "pick_place", "push")
        rewards = [config.reward.gamma for config in env.envs.get_attr("config")]
        assert rewards == [default_discount(env.max_episode_steps)] * 3, "PPO has one for all"
        assert env.tasks == 2
    finally:
        env.close()


def test_every_task_meets_every_scene_of_a_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings give seeds in steps of the number of environments, and 64 scenes follow from the seed."""
    env = ManiSkillTensorEnv(WmrlManiSkillEnv(task="push,pick_place", image_size=32), 2, "cpu")
    given: list[list[int]] = []

    def begin(seed: list[int], options: object) -> None:
        given.append(seed)
        raise StopIteration

    monkeypatch.setattr(env.envs, "reset", begin)
    try:
        for first in [*range(0, 1000, 2), 0]:
            with pytest.raises(StopIteration):
                env.reset(seed=first)
    finally:
        env.close()
    seeds = np.array(given)
    assert sorted(seeds[:-1].flatten()) == [*range(1000)]
    assert seeds[-1].tolist() == seeds[0].tolist()
    assert [len(np.unique(each % 64)) for each in seeds.T] == [64, 64]


def test_the_longest_task_decides_the_horizon() -> None:
    assert WmrlManiSkillEnv(task="push,pick_place").horizon == TASKS["pick_place"].horizon
    assert WmrlManiSkillEnv(task="push,pick_place", episode_length=7).horizon == 7


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("push,stack", "^task=stack: unknown; choose one of push, "),
        ("push,pull,push", "^task=push,pull,push: names a task twice"),
        (None, "^task=None: unknown"),
    ],
)
def test_unknown_tasks_are_named(task: str | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WmrlManiSkillEnv(task=task).selected_scenes()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cameras": ["ceiling"]}, "^cameras="),
        ({"image_size": 4}, "^image_size=4: must be at least 16"),
        ({"episode_length": 0}, "^episode_length=0: must be at least 1"),
        ({"robot_mesh_detail": 0.0}, "^robot_mesh_detail=0.0"),
    ],
)
def test_bad_settings_are_named(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WmrlManiSkillEnv(**fields)


def test_unknown_tasks_and_foreign_scenes_are_named_before_anything_is_built() -> None:
    with pytest.raises(ValueError, match="task=juggle"):
        WmrlManiSkillEnv(task="juggle").selected_scenes()
    with pytest.raises(ValueError, match="split 'ood' has"):
        WmrlManiSkillEnv(split="ood", scenes=[0]).selected_scenes()


class Solving:
    """A simulation in which the object comes nearer with every step, and is there after two."""

    instruction = "push it"

    def reset(self, *_: object) -> Frame:
        self.steps = 0
        return self._frame()

    def step(self, _: np.ndarray) -> Frame:
        self.steps += 1
        return self._frame()

    def close(self) -> None:
        pass

    def _frame(self) -> Frame:
        images = {"third_view": np.zeros((64, 64, 3), np.uint8)}
        return Frame(images, {}, np.zeros(8, np.float32), reward=self.steps / 4, success=self.steps == 2)


def test_success_ends_an_episode_and_is_paid_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WmrlManiSkillEnv, "create_simulation", lambda _: Solving())
    config = WmrlManiSkillEnv(episode_length=5, cameras=["third_view"], image_size=64)
    env = ManiSkillTensorEnv(config, 1, "cpu")
    env.reset(seed=0)
    first, second = (env.step(torch.zeros(1, 7)) for _ in range(2))
    expected = [config.reward.step_reward(float(k == 2), k / 4, (k - 1) / 4, 5) for k in (1, 2)]
    assert [first[1].item(), second[1].item()] == pytest.approx(expected)
    assert expected[1] > 0.5 > expected[0]
    assert [first[2].item(), second[2].item(), second[3].item()] == [False, True, False]
    assert second[4]["final_info"]["is_success"].tolist() == [True]
    assert second[4]["final_info"]["episode_length"].tolist() == [2]
    env.close()
