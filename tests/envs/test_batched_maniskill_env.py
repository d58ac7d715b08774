"""The batched environment, one episode of it: what lerobot-eval and PPO see, and when an episode is over."""

import logging
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.batched_maniskill_env import BatchedManiSkillEnv
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
from lerobot_wmrl.envs.maniskill_env import ManiSkillTensorEnv
from lerobot_wmrl.maniskill.batched import BatchedFrame, BatchedSimulation
from lerobot_wmrl.maniskill.episode import RunningEpisode
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import TASKS

HORIZON = 3
CONFIG = WmrlManiSkillEnv(episode_length=HORIZON, image_size=32, split="ood")
STAY = torch.tensor([[0.0, 0, 0, 0, 0, 0, -1]])


@pytest.fixture(scope="module")
def simulation() -> Iterator[BatchedSimulation]:
    """One simulation for all tests: to build it takes ten seconds."""
    simulation = CONFIG.create_batched_simulation(1, "cpu")
    yield simulation
    simulation.close()


@pytest.fixture
def env(
    request: pytest.FixtureRequest, simulation: BatchedSimulation, monkeypatch: pytest.MonkeyPatch
) -> BatchedManiSkillEnv:
    """An environment, with `restart` as the test asks, that leaves the simulation open."""
    monkeypatch.setattr(WmrlManiSkillEnv, "create_batched_simulation", lambda *_: simulation)
    monkeypatch.setattr(simulation, "close", lambda: None)
    return BatchedManiSkillEnv(CONFIG, 1, "cpu", restart=request.param)


@pytest.mark.parametrize("env", [True], indirect=True)
def test_it_observes_and_restarts_as_the_simulators_in_processes_do(env: BatchedManiSkillEnv) -> None:
    other = ManiSkillTensorEnv(CONFIG, 1, "cpu")
    try:
        results = [each.reset(seed=[EVALUATION_SEED])[0] for each in (env, other)]
        for key in results[1]:
            if key == "task":
                assert results[0][key] == results[1][key]
            else:
                torch.testing.assert_close(results[0][key], results[1][key], atol=1e-3, rtol=0.0)
        for step in range(HORIZON):
            mine, theirs = env.step(STAY), other.step(STAY)
            torch.testing.assert_close(mine[1], theirs[1], atol=1e-3, rtol=0.0)
            assert bool(mine[3][0]) == bool(theirs[3][0]) == (step == HORIZON - 1)
    finally:
        other.close()
    assert set(mine[4]) == set(theirs[4]) == {"final_obs", "final_info", "reward_parts"}
    assert mine[4]["reward_parts"].keys() == theirs[4]["reward_parts"].keys()
    assert mine[4]["final_info"]["episode_length"].tolist() == [HORIZON]
    assert not torch.equal(mine[0]["observation.state"], mine[4]["final_obs"]["observation.state"])
    assert not env.step(STAY)[3].any()


@pytest.mark.parametrize("env", [False], indirect=True)
def test_lerobot_eval_gets_arrays_and_the_success_by_scene(
    env: BatchedManiSkillEnv, caplog: pytest.LogCaptureFixture
) -> None:
    adapter = EvaluationAdapter(env)
    observation, _ = adapter.reset(seed=[EVALUATION_SEED])
    assert observation["pixels"]["third_view"].shape == (1, 32, 32, 3)
    assert adapter.call("render")[0].dtype == np.uint8
    for _ in range(HORIZON + 1):
        result = adapter.step(STAY.numpy())
    assert result[4]["final_info"]["is_success"].tolist() == [False]
    with caplog.at_level(logging.INFO):
        adapter.close()
    assert "(0 of 1;" in caplog.text


class MadeUpSimulation:
    """Three rows without physics: an episode succeeds when its actions have lifted by 10 cm."""

    device = torch.device("cpu")

    def __init__(self, scenes: tuple[Scene, ...]) -> None:
        self.episodes = [RunningEpisode(TASKS["push"], scenes[0], 0)] * 3
        self.height = torch.zeros(3)

    def reset(self, scenes: list[Scene], seeds: list[int], rows: list[int]) -> BatchedFrame:
        assert list(rows) == sorted(rows)
        for scene, seed, row in zip(scenes, seeds, rows, strict=True):
            self.episodes[row] = RunningEpisode(TASKS["push"], scene, seed)
            self.height[row] = 0.0
        return self._frame()

    def step(self, action: torch.Tensor) -> BatchedFrame:
        self.height = self.height + action[:, 2]
        return self._frame()

    def _frame(self) -> BatchedFrame:
        images = {"third_view": torch.zeros(3, 32, 32, 3, dtype=torch.uint8)}
        state = self.height[:, None].repeat(1, 8)
        return BatchedFrame(images, state, self.height, self.height >= 0.1)


def test_one_row_ends_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = CONFIG.selected_scenes()
    monkeypatch.setattr(
        WmrlManiSkillEnv, "create_batched_simulation", lambda config, n, device: MadeUpSimulation(scenes)
    )
    env = BatchedManiSkillEnv(WmrlManiSkillEnv(episode_length=5, image_size=32, split="ood"), 3, "cpu", True)
    before, _ = env.reset(seed=[7, 8, 9])
    lift = torch.zeros(3, 7)
    lift[1, 2] = 0.05
    env.step(lift)
    observation, reward, terminated, truncated, info = env.step(lift)
    assert terminated.tolist() == info["final_info"]["is_success"].tolist() == [False, True, False]
    assert reward[1].item() == pytest.approx(env.config.reward.step_reward(1.0, 0.1, 0.05, 5))
    assert reward[1] > 0.5 > reward[0]
    assert not truncated.any()
    assert info["final_info"]["episode_length"].tolist() == [2, 2, 2]
    assert info["final_obs"]["observation.state"][:, 0].tolist() == pytest.approx([0.0, 0.1, 0.0])
    assert observation["observation.state"][:, 0].tolist() == [0.0, 0.0, 0.0]
    seeds = [episode.seed for episode in env.simulation.episodes]
    assert (seeds[0], seeds[2]) == (7, 9)
    assert seeds[1] != 8
    assert seeds[1] < EVALUATION_SEED
    assert [observation["task"][row] for row in (0, 2)] == [before["task"][row] for row in (0, 2)]
    assert observation["task"][1] == env.simulation.episodes[1].start.instruction
    for _ in range(3):
        truncated = env.step(torch.zeros(3, 7))[3]
    assert truncated.tolist() == [True, False, True]


def test_batched_without_cuda_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^batched=True: .* leave it out"):
        WmrlManiSkillEnv(batched=True).create_tensor_env(1, "cpu")


def test_a_batch_has_one_task() -> None:
    with pytest.raises(ValueError, match=r"^task=push,pull: a batched simulation has one task; choose one"):
        WmrlManiSkillEnv(task="push,pull").create_batched_simulation(1, "cpu")


@pytest.mark.parametrize("env", [True], indirect=True)
def test_an_action_that_is_no_number_is_refused(env: BatchedManiSkillEnv) -> None:
    env.reset(seed=[EVALUATION_SEED])
    with pytest.raises(ValueError, match=r"action: NaN in environments \[0\]"):
        env.step(STAY * torch.nan)
