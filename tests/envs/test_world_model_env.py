"""An environment in which a world model is the simulator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from gymnasium.vector import AutoresetMode

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.pipeline import unchanged
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
from lerobot_wmrl.envs.world_model_env import make_success_env
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.similarity import TokenizerSimilarity
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.frame_tokenizer import Decoded
from tests.envs.imagination import IMAGE, STATE, B, always_done
from tests.trained import CLIP_LENGTH, run_training


def test_the_observation_is_what_the_config_announces(config, env):
    observation, _ = env.reset(seed=0)
    assert observation[IMAGE].shape == (B, 3, 32, 32)
    assert observation[STATE].shape == (B, 8)
    assert len(observation["task"]) == B
    arrays = {name: value.numpy() for name, value in observation.items() if name != "task"}
    assert env.observation_space.contains(arrays)
    assert config.features["pixels/third_view"].shape == (32, 32, 3)
    assert config.features["agent_pos"].shape == (8,)


def test_the_same_seed_and_actions_give_the_same_episode(env):
    def roll() -> tuple[torch.Tensor, torch.Tensor]:
        env.reset(seed=7)
        steps = [env.step(torch.full((B, 7), 0.01)) for _ in range(7)]
        return torch.stack([step[0][IMAGE] for step in steps]), torch.stack([step[1] for step in steps])

    for a, b in zip(roll(), roll(), strict=True):
        assert torch.equal(a, b)


def test_policy_actions_are_what_the_policy_would_do_and_no_episode_moves(config):
    """From a start on, imagination is the same whether the episode goes on or not."""
    env, other = config.create_tensor_env(B), config.create_tensor_env(B)

    def act(observation) -> torch.Tensor:
        """Depends on every part of the observation."""
        seen = observation[IMAGE].mean((1, 2, 3)) + observation[STATE].sum(1)
        told = torch.tensor([len(text) for text in observation["task"]])
        return (0.01 * (seen + told)[:, None] - 0.1).expand(-1, 7)

    observation, _ = other.reset(seed=3)
    taken = []
    for _ in range(4):
        taken.append(act(observation).clamp(env.action_low, env.action_high))
        observation, *_ = other.step(taken[-1])
    env.reset(seed=3)
    rows = torch.tensor([2, 0])
    torch.testing.assert_close(
        env.policy_actions(act, rows, 4), torch.stack(taken, 1)[rows], atol=1e-4, rtol=0
    )
    for step in range(4):
        seen, *_ = env.step(taken[step])
    torch.testing.assert_close(seen[IMAGE], observation[IMAGE])


def test_spaces_take_no_memory_until_they_are_asked_for(env):
    """Their bounds are as large as the frames of all environments."""
    env.reset(seed=0)
    env.step(env.action_low.expand(env.num_envs, -1))
    spaces = {"observation_space", "single_observation_space"}
    assert not spaces & vars(env).keys()
    assert env.observation_space[IMAGE].shape[0] == env.num_envs
    assert spaces <= vars(env).keys()


def test_environments_with_one_seed_begin_alike(env):
    observation, _ = env.reset(seed=[1_000_003, 1_000_003, 4, 4])
    for values in (observation[IMAGE], observation[STATE]):
        assert torch.equal(values[0], values[1])
        assert torch.equal(values[2], values[3])
    assert not torch.equal(observation[STATE][0], observation[STATE][2])


def test_truncated_at_the_horizon_with_the_final_observation_kept(env):
    env.reset(seed=0)
    always_done(env, torch.zeros(B, dtype=torch.bool))
    for _ in range(4):
        *_, terminated, truncated, info = env.step(torch.zeros(B, 7))
        assert not (terminated | truncated).any()
        assert "final_obs" not in info
    observation, _, terminated, truncated, info = env.step(torch.zeros(B, 7))
    assert truncated.all()
    assert not terminated.any()
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert not info["final_info"]["is_success"].any()
    assert info["final_info"]["episode_length"].tolist() == [5] * B
    starts = env.starts.frames.state[env._start_index]
    assert torch.equal(observation[STATE], starts)
    assert not torch.equal(info["final_obs"][STATE], starts)


def test_done_must_hold_for_k_frames_and_is_paid_once(env):
    env.reset(seed=0)
    flags = torch.tensor([True, False, True, False])
    always_done(env, flags)
    for step in range(3):
        _, reward, terminated, _, info = env.step(torch.zeros(B, 7))
        assert torch.equal(terminated, flags & (step == 2))
        assert torch.equal(info["reward_parts"]["success"] > 0, terminated)
        assert torch.equal(reward > 0.5, terminated)
    assert torch.equal(info["final_info"]["is_success"], flags)


def test_goals_that_were_never_reached_are_counted(env):
    """Eq. 6 without a frame that reaches θ: the metric is the share of environments with a reached goal."""
    env.reset(seed=list(range(B)))
    env.goals = env.goals._replace(reached=torch.arange(len(env.starts)) % 2 == 0)
    *_, info = env.step(torch.zeros(B, 7))
    assert info["reward_parts"]["goal_reached"].tolist() == [True, False, True, False]


def test_features_of_goals_are_computed_once_and_those_of_every_frame_once(config):
    """However often an episode begins from the same start."""
    calls: list[int] = []
    features = TokenizerSimilarity.features

    def counted(self: TokenizerSimilarity, frame: Decoded) -> list[torch.Tensor]:
        calls.append(len(frame.images))
        return features(self, frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TokenizerSimilarity, "features", counted)
        env = config.create_tensor_env(B)
        starts = len(env.starts)
        assert sorted(calls) == [starts, starts]
        env.reset(seed=0)
        for _ in range(2 * config.episode_length):
            env.step(torch.zeros(B, 7))
    assert calls[2:] == [B] * 2 * config.episode_length


def test_without_a_dense_part_no_goal_and_no_text_model_is_needed(config):
    sparse = replace(config, text_world_model_path="", reward=GeneralConfig(device="cpu", alpha=1.0))
    env = sparse.create_tensor_env(B)
    env.reset(seed=0)
    always_done(env, torch.tensor([True, False, True, False]))
    for _ in range(3):
        _, reward, *_, info = env.step(torch.zeros(B, 7))
    assert reward.tolist() == [1, 0, 1, 0]
    assert "similarity" not in info["reward_parts"]
    with pytest.raises(ValueError, match=r"^text_world_model_path=: .*`reward\.alpha` to 1"):
        replace(config, text_world_model_path="")


def test_an_episode_that_restarts_forgets_what_came_before(env):
    always_done(env, torch.tensor([True, False, False, False]))
    env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(torch.full((B, 7), 0.02))
    index = env._start_index.tolist()
    after, *_ = env.step(torch.full((B, 7), 0.01))
    fresh, _ = env.reset(seed=index)
    torch.testing.assert_close(fresh[IMAGE][0], observation[IMAGE][0])
    alone, *_ = env.step(torch.full((B, 7), 0.01))
    torch.testing.assert_close(alone[STATE][0], after[STATE][0], atol=1e-5, rtol=1e-4)
    assert not torch.allclose(alone[STATE][1], after[STATE][1], atol=1e-5)


def test_actions_are_clipped_to_their_range_and_counted(env):
    env.reset(seed=1)
    far, *_, info = env.step(torch.tensor([*ACTION_HIGH[:-1], 9.0]).expand(B, 7))
    assert info["reward_parts"]["clipped"].tolist() == pytest.approx([1 / 7] * B)
    env.reset(seed=1)
    edge, *_, info = env.step(torch.tensor(ACTION_HIGH).expand(B, 7))
    assert torch.equal(far[STATE], edge[STATE])
    assert not info["reward_parts"]["clipped"].any()


def test_lerobot_eval_says_how_many_actions_were_out_of_range(env, caplog):
    adapter = EvaluationAdapter(env)
    adapter.reset(seed=1)
    adapter.step(np.zeros((B, 7), np.float32))
    adapter.step(np.full((B, 7), 9.0, np.float32))
    adapter.close()
    assert "50.0 % of the components" in caplog.text


def test_lerobot_eval_says_that_episodes_begin_where_others_have(env, caplog):
    adapter, count = EvaluationAdapter(env), len(env.starts)
    assert count % B, "so that the last batch is filled up"
    for begin in (*range(0, count, B), 0):  # in the end for another policy: the same seeds
        adapter.reset(seed=list(range(begin, begin + B)))
    assert "starts" not in caplog.text
    for begin in (count, count + B):
        adapter.reset(seed=list(range(begin + B, begin + 2 * B)))
    assert caplog.text.count(f"there are {count} starts for more episodes") == 1
    assert f"Ask for {count} episodes" in caplog.text


def test_actions_that_are_none_are_refused(env):
    """NaN would stay in an environment's state until its episode ends; one column would be taken for all."""
    env.reset(seed=1)
    actions = torch.zeros(B, 7)
    actions[2, 0] = torch.nan
    with pytest.raises(ValueError, match=r"action: NaN in environments \[2\]"):
        env.step(actions)
    for shape in ((7,), (1, 7), (B, 1), (B, 6)):
        with pytest.raises(ValueError, match=r"action: shape .*but 4 environments take \(4, 7\)"):
            env.step(torch.zeros(shape))


def test_actions_of_any_number_format_are_taken(env):
    """NumPy's own is float64; gymnasium samples arrays."""
    env.reset(seed=1)
    expected = env.step(torch.full((B, 7), 0.25))[0][STATE]
    for actions in (torch.full((B, 7), 0.25, dtype=torch.float64), np.full((B, 7), 0.25, np.float32)):
        env.reset(seed=1)
        assert torch.equal(env.step(actions)[0][STATE], expected)


def test_seeds_of_every_kind_of_integer_and_sequence_count(env):
    def begun(seed) -> list[int]:
        env.reset(seed=seed)
        return [*env._start_index.tolist(), *env._draw_starts().tolist()]

    assert begun(np.int64(3)) == begun(3)
    assert begun((5, 4, 3, 2)) == begun(range(5, 1, -1)) == begun(np.arange(5, 1, -1)) == begun([5, 4, 3, 2])
    with pytest.raises(ValueError, match="seed: 2 seeds for 4 environments"):
        env.reset(seed=[1, 2])


def test_environments_without_a_seed_do_not_all_begin_alike(config):
    first, second = (config.create_tensor_env(1).generator.initial_seed() for _ in range(2))
    assert first != second


def test_lerobot_eval_gets_numpy_and_frozen_episodes(config):
    adapter = config.create_envs(B)["world_model"][0]
    assert isinstance(adapter, EvaluationAdapter)
    observation, _ = adapter.reset(seed=[3, 4, 5, 6], options={"lerobot_new_rollout": True})
    assert observation["pixels"]["third_view"].dtype == np.uint8
    assert observation["pixels"]["third_view"].shape == (B, 32, 32, 3)
    assert adapter.observation_space.contains(observation)
    assert adapter.call("_max_episode_steps") == (5,) * B
    assert len(adapter.call("task_description")) == B
    always_done(adapter.env, torch.tensor([True, False, False, False]))
    for _ in range(3):
        ended, _, terminated, _, info = adapter.step(np.zeros((B, 7), np.float32))
    assert terminated.tolist() == [True, False, False, False]
    assert info["final_info"]["is_success"].tolist() == [True, False, False, False]
    later, reward, terminated, _, info = adapter.step(np.ones((B, 7), np.float32))
    assert reward[0] == 0
    assert not terminated[0]
    assert np.array_equal(later["pixels"]["third_view"][0], ended["pixels"]["third_view"][0])
    assert info["final_info"]["is_success"][0]


def test_lerobot_eval_gets_an_environment_for_each_task(config, make_synthetic_dataset, tmp_path):
    """Episodes of two tasks; both environments share their models."""
    dataset = make_synthetic_dataset(tmp_path / "two", episodes=6)
    file = next((tmp_path / "two" / "data").rglob("*.parquet"))
    rows = pq.read_table(file)
    index = rows.schema.get_field_index("start.task")
    task = (rows["episode_index"].to_numpy() < 2) * 2
    pq.write_table(rows.set_column(index, rows.schema.field(index), [task]), file)
    envs = replace(config, dataset=StartFrames(root=str(dataset.root))).create_envs(B)["world_model"]
    assert {task: len(env.env.starts) for task, env in envs.items()} == {0: 4, 2: 2}
    assert envs[0].env.model is envs[2].env.model


def test_models_that_do_not_fit_together_are_refused(config, small_dataset, trained_models, tmp_path):
    from tests.trained import text_config, train_tokenizer

    root = Path(small_dataset.root)
    other = train_tokenizer(root, tmp_path / "tokenizer", steps=1, seed=9)
    text = run_training(text_config(other), root, tmp_path / "text", steps=1)
    with pytest.raises(ValueError, match="another tokenizer"):
        replace(config, text_world_model_path=str(text)).create_tensor_env(1)
    evaluation = EvalWorldModelConfig(
        model=Checkpoint(str(trained_models["action_world_model"])),
        text_model=Checkpoint(str(text)),
        dataset=ChosenEpisodes(str(root)),
        output_dir=tmp_path / "evaluation",
    )
    with pytest.raises(ValueError, match="another tokenizer"):
        eval_world_model(evaluation)
    assert not evaluation.output_dir.exists()
    with pytest.raises(ValueError, match="'text_world_model' is needed"):
        replace(config, text_world_model_path=str(trained_models["action_world_model"])).create_tensor_env(1)


def test_entropies_say_how_uncertain_the_world_model_is(config):
    """Done is certain, as likely as not, unlikely and excluded."""
    logits = torch.tensor([20.0, 0.0, -2.0, -20.0])
    env = config.create_tensor_env(B)
    step = env.model.step
    env.model.step = lambda *args: step(*args)._replace(done_logit=logits, entropy=torch.arange(4.0))
    env.reset(seed=0)
    parts = env.step(torch.zeros(B, 7))[-1]["reward_parts"]
    torch.testing.assert_close(parts["done_entropy"], torch.tensor([0, 0.6931, 0.3653, 0]), atol=1e-3, rtol=0)
    assert parts["token_entropy"].tolist() == [0, 1, 2, 3]


def test_a_refreshed_model_shows_frames_of_the_size_that_the_policy_knows(config, trained_models):
    """Though it was trained further on larger ones."""
    env = config.create_tensor_env(B)
    model = load_model(trained_models["action_world_model"], "action_world_model")
    model.config.tokenizer = replace(model.config.tokenizer, frame_sizes=[[48, 48]])
    env.adopt(model)
    image = env.reset(seed=0)[0][IMAGE]
    assert image.shape == env.step(torch.zeros(B, 7))[0][IMAGE].shape == (B, 3, 32, 32)


def test_compact_frames_become_those_that_a_policy_sees(config):
    """They are stored as small as they are imagined."""
    seen = []
    for compact in (False, True):
        env = config.create_tensor_env(B)
        env.model.config.tokenizer = replace(env.model.config.tokenizer, frame_sizes=[[48, 80]])
        shown = env.store_compact() if compact else unchanged
        first, _ = env.reset(seed=0)
        later = env.step(torch.zeros(B, 7))[0]
        assert {each[IMAGE].shape[1:] for each in (first, later)} == {(3, 32, 32) if compact else (3, 48, 80)}
        seen.append([shown(each) for each in (first, later)])
        assert make_success_env(env, env.starts, B + 1).reset(seed=0)[0][IMAGE].shape == (B, 3, 48, 80)
        assert make_success_env(env, env.starts, 1).reset(seed=0)[0][IMAGE].shape == (1, 3, 48, 80)
    for full, stored in zip(*seen, strict=True):
        assert full.keys() == stored.keys()
        assert full[IMAGE].shape == (B, 3, 48, 80)
        assert torch.equal(full[IMAGE], stored[IMAGE])


def test_success_alone_is_rewarded_where_nothing_imagines_a_goal(trained_models):
    path, text = (str(trained_models[kind]) for kind in ("action_world_model", "text_world_model"))
    assert WorldModelEnv(world_model_path=path).reward.alpha == 1
    assert WorldModelEnv(world_model_path=path, text_world_model_path=text).reward.alpha == 0.9
    given = GeneralConfig(alpha=0.5)
    assert WorldModelEnv(world_model_path=path, text_world_model_path=text, reward=given).reward.alpha == 0.5
    with pytest.raises(ValueError, match=r"^text_world_model_path=: .* or set `reward\.alpha` to 1"):
        WorldModelEnv(world_model_path=path, reward=given)


def test_episodes_last_as_long_as_the_world_model_has_learnt(config, trained_models, caplog):
    path = str(trained_models["action_world_model"])
    by_default = replace(config, episode_length=None)
    assert by_default.horizon == CLIP_LENGTH
    by_default.create_tensor_env(1)
    assert "longer than the clips" not in caplog.text
    replace(config, episode_length=CLIP_LENGTH + 1).create_tensor_env(1)
    assert (
        f"imagined episodes of {CLIP_LENGTH + 1} frames are longer than the clips of {CLIP_LENGTH}"
        in caplog.text
    )
    with pytest.raises(ValueError, match=f"episode_length={CLIP_LENGTH}: shorter than the 11 frames"):
        WorldModelEnv(world_model_path=path, done_frames=11, reward=GeneralConfig(alpha=1.0))
    with pytest.raises(ValueError, match="world_model_path: is missing"):
        _ = WorldModelEnv().horizon
