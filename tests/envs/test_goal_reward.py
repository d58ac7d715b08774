"""What the environment pays for going to the goal frame, for leaving it, and for staying where it is."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lpips import LPIPS
from torch import Tensor

from lerobot_wmrl.envs import starts
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import default_discount
from lerobot_wmrl.rewards.similarity import PerceptualSimilarity, Similarity, make_similarity

STILL = torch.zeros(1, 7)


@pytest.fixture(scope="module")
def config(small_dataset, trained_models) -> WorldModelEnv:
    return WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        text_world_model_path=str(trained_models["text_world_model"]),
        dataset=StartFrames(root=str(Path(small_dataset.root)), max_starts=1),
        episode_length=50,
        done_threshold=0.999,
    )


@pytest.fixture(params=["tokenizer", "mse", "lpips"])
def measure(request) -> Similarity:
    """LPIPS with its own linear heads, on a backbone that was never trained: nothing is downloaded."""
    if request.param != "lpips":
        return make_similarity(request.param, torch.device("cpu"))
    torch.manual_seed(0)
    return PerceptualSimilarity(LPIPS(net="alex", pnet_rand=True, verbose=False).requires_grad_(False))


def way_to_goal(env: WorldModelVectorEnv) -> list[Tensor]:
    """Tokens (1, S) of the start, of a frame in between, and of one in which all are others."""
    tokens = env.starts.frames.tokens
    goal = (tokens + 7) % 20
    return [tokens, torch.where(torch.arange(tokens.shape[1]) % 2 == 0, goal, tokens), goal]


def set_goal(env: WorldModelVectorEnv, measure: Similarity, tokens: Tensor) -> None:
    """The goal frame of the one start."""
    frames = torch.cat([env.starts.frames.tokens, tokens])
    context = env.starts.frames.context
    begin, goal = (measure.features(env.model.decode(frame[None], context)) for frame in frames)
    similarity = measure(begin, goal, env.model.tokenizer.num_cameras)
    assert env.goals is not None
    env.goals = env.goals._replace(features=goal, measure=measure, similarity=similarity)


def paid_along(env: WorldModelVectorEnv, way: list[Tensor], done: float = -20.0) -> list[float]:
    """What is paid when these frames are imagined."""
    step, paid, logit = env.model.step, [], torch.tensor([done])
    for tokens in way:
        env.model.step = lambda *args, seen=tokens: step(*args)._replace(tokens=seen, done_logit=logit)
        paid.append(env.step(STILL)[1].item())
    env.model.step = step
    return paid


def test_starts_are_the_same_however_many_are_tokenised_at_once(config, monkeypatch):
    """So that memory does not grow with their number."""
    config = replace(config, dataset=StartFrames(root=config.dataset.root))
    whole = config.create_tensor_env(1)
    monkeypatch.setattr(starts, "STARTS_AT_ONCE", 4)
    cut = config.create_tensor_env(1)
    assert len(cut.starts) == 6
    assert torch.equal(cut.starts.frames.tokens, whole.starts.frames.tokens)
    torch.testing.assert_close(cut.starts.images, whole.starts.images)
    torch.testing.assert_close(cut.goals.similarity, whole.goals.similarity)
    for one, other in zip(cut.goals[0], whole.goals[0], strict=True):
        torch.testing.assert_close(one, other)


def test_going_to_the_goal_pays_and_leaving_it_costs(config, measure):
    """An LPIPS that is taken for a similarity pays the wrong way round."""
    dense = replace(config, reward=GeneralConfig(device="cpu", alpha=0.0, gamma=1.0))
    env = dense.create_tensor_env(1)
    way = way_to_goal(env)
    set_goal(env, measure, way[-1])
    env.reset(seed=0)
    closer, away = paid_along(env, [way[-1], way[0]])
    assert closer == pytest.approx(1 - env.goals.similarity.item(), abs=1e-5)
    assert away == pytest.approx(-closer, abs=1e-5)
    assert closer > 1e-4


def test_the_paper_s_reward_is_largest_at_the_goal(config, measure):
    absolute = replace(config, reward=GeneralConfig(device="cpu", alpha=0.0, form="absolute"))
    env = absolute.create_tensor_env(1)
    way = way_to_goal(env)
    set_goal(env, measure, way[-1])
    env.reset(seed=0)
    begin, between, goal = paid_along(env, way)
    assert max(begin, between) < goal == pytest.approx(1, abs=1e-5)


def test_by_default_lingering_earns_nothing_and_done_ends_the_episode(config, measure):
    """Amid the way and at the goal; the next episode is not paid for where the last one was."""
    env = replace(config, reward=GeneralConfig(device="cpu")).create_tensor_env(1)
    way = way_to_goal(env)
    set_goal(env, measure, way[-1])
    env.reset(seed=0)
    for frame in way[1:]:
        assert max(paid_along(env, [frame] * 4)[1:]) <= 0
    for row, paid in enumerate(paid_along(env, [way[-1]] * config.done_frames, done=20.0), start=1):
        assert (paid > 0.5) == (row == config.done_frames)
    assert env._elapsed.item() == 0
    assert paid_along(env, way[:1])[0] == pytest.approx(
        0.1 * (default_discount(config.horizon) - 1) * env.goals.similarity.item(), abs=1e-5
    )
