"""The batched environment, one episode of it: what lerobot-eval and PPO see, and when an episode is over."""

import logging
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from lerobot_wmrl.constants import EVALUATION_SEED
from lerobot_wmrl.envs.batched_maniskill_env import BatchedManiSkillEnv
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
from lerobot_wmrl.envs.maniskill_tensor_env import ManiSkillTensorEnv

HORIZON = 3
CONFIG = WmrlManiSkillEnv(episode_length=HORIZON, image_size=32, split="ood")
STAY = torch.tensor([[0.0, 0, 0, 0, 0, 0, -1]])


@pytest.fixture
def env(request: pytest.FixtureRequest) -> Iterator[BatchedManiSkillEnv]:
    env = BatchedManiSkillEnv(CONFIG, 1, "cpu", restart=request.param)
    yield env
    env.close()


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
    assert set(mine[4]) == set(theirs[4]) == {"final_obs", "final_info"}
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


def test_jitter_is_refused() -> None:
    with pytest.raises(ValueError, match=r"--env.light_jitter.*--env.batched=false"):
        WmrlManiSkillEnv(light_jitter=0.1).create_batched_simulation(1, "cpu")
