"""Imagined episodes, recorded as a LeRobotDataset: no simulator."""

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.merging import merge_folders
from lerobot_dataset_maniskill.record import run
from lerobot_dataset_maniskill.recorder import record
from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_wmrl.common.constants import KINDS, START_KIND, START_SCENE, START_SEED, START_TASK
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.data.dataset import DatasetSource, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from tests.rl.checkpoints import save_untrained_policy
from tests.trained import action_config, run_training, train_tokenizer

LENGTH = 4
IMAGE = "observation.images.third_view"


@pytest.fixture
def config(small_dataset, trained_models, tmp_path) -> RecordConfig:
    """Seven episodes, from six starts, in parts of three, of which none succeeds."""
    env = WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(Path(small_dataset.root))),
        reward=GeneralConfig(alpha=1.0),
        episode_length=LENGTH,
        done_threshold=0.9999,
        done_frames=2,
        device="cpu",
    )
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    return RecordConfig(
        output_dir=tmp_path / "imagined",
        env=env,
        num_episodes=7,
        part_episodes=3,
        policy=read_policy_config(str(policy), []),
    )


def test_every_row_is_what_the_world_model_imagined(config, small_dataset):
    """The first frames are those of the dataset's episodes, as the tokenizer draws them; the next states
    are those that the same actions lead to in the environment."""
    config.video = False
    record(config)
    table, real = read_episodes(open_dataset(config.root)), read_episodes(small_dataset)
    assert table.length.tolist() == [LENGTH] * 7
    assert set(table.columns[START_KIND]) == {KINDS.index("policy")}
    for name in (START_SEED, START_SCENE, START_TASK):
        assert table.columns[name].tolist() == [real.columns[name][index % 6] for index in range(7)]
    dataset = LeRobotDataset("local/imagined", root=config.root)
    rows = dataset.hf_dataset.with_format("torch")[: 3 * LENGTH]
    env = config.env.create_tensor_env(3)
    observation, _ = env.reset(seed=[0, 1, 2])
    actions, states = (rows[name].unflatten(0, (3, LENGTH)) for name in ("action", "observation.state"))
    for step in range(LENGTH):
        torch.testing.assert_close(observation["observation.state"], states[:, step], atol=1e-5, rtol=1e-4)
        if step == 0:
            shown = torch.stack([dataset[LENGTH * index][IMAGE] for index in range(3)])
            assert (shown - observation[IMAGE]).abs().max() <= 0.5 / 255 + 1e-6
        observation, *_ = env.step(actions[:, step])
    ends = np.arange(1, 7 * LENGTH + 1) % LENGTH == 0
    truncated = dataset.hf_dataset.with_format("numpy")["next.truncated"][:].reshape(-1)
    assert np.array_equal(truncated, ends)


def test_starts_of_several_tasks_come_in_the_order_of_the_dataset(config, make_synthetic_dataset, tmp_path):
    root = make_synthetic_dataset(tmp_path / "tasks", episodes=6).root
    (file,) = root.glob("data/**/*.parquet")
    table = pq.read_table(file)
    index = table.schema.get_field_index("start.task")
    of_two = pa.array(np.array(table["episode_index"]) // 4)  # four episodes of one task, two of another
    pq.write_table(table.set_column(index, table.schema.field(index), of_two), file)
    config.env.dataset.root, config.video = str(root), False
    record(config)
    imagined, real = read_episodes(open_dataset(config.root)), read_episodes(open_dataset(root))
    begun = [index % 6 for index in range(7)]
    for name in (START_SEED, START_SCENE, START_TASK):
        assert imagined.columns[name].tolist() == real.columns[name][begun].tolist()
    assert np.allclose(imagined.state[imagined.start], real.state[real.start][begun], atol=1e-5)


def test_they_can_be_merged_with_the_dataset_that_they_begin_in(config, small_dataset, tmp_path):
    config.like, config.num_episodes = DatasetSource(str(small_dataset.root)), 2
    record(config)
    merge_folders([Path(small_dataset.root), config.root], tmp_path / "merged", "local/merged")
    merged = read_episodes(open_dataset(tmp_path / "merged"))
    assert merged.columns[START_SEED][-2:].tolist() == merged.columns[START_SEED][:2].tolist()


NAMED, ENDS = {"names": list("abcdefg")}, {"info": {"low": [-1.0] * 7, "high": [0.5] * 7}}


@pytest.mark.parametrize(
    ("action", "fps", "problem"),
    [
        (NAMED, 25, "its action has the components a, b, c, d, e, f, g, the world model has learnt "),
        (ENDS, 25, r"its actions range from \[-1.0, .* to \[0.5, .*, those of the world model: "),
        ({}, 30, "has 30 frames a second, the world model has learnt 25"),
    ],
)
def test_columns_of_another_robot_are_refused(config, small_dataset, tmp_path, action, fps, problem):
    shutil.copytree(small_dataset.root, tmp_path / "other")
    file = tmp_path / "other" / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"]["action"].update(action)
    file.write_text(json.dumps({**info, "fps": fps}))
    config.like = DatasetSource(str(tmp_path / "other"))
    with pytest.raises(FieldError, match=rf"^like\.root=.*: {problem}"):
        record(config)


def test_published_they_say_that_they_are_imagined(config, hub):
    config.num_episodes, config.repo_id, config.push_to_hub = 1, "somebody/imagined", True
    run(config)
    assert "- imagined" in hub.dataset("somebody/imagined").head["README.md"].decode()


def test_columns_of_other_data_are_refused_in_maniskill(small_dataset, tmp_path):
    like = DatasetSource(str(small_dataset.root))
    simulated = RecordConfig(output_dir=tmp_path / "simulated", num_episodes=1, like=like)
    with pytest.raises(ValueError, match=r"^like\.root=.*columns of their own; leave it out"):
        record(simulated)


def test_what_never_varied_in_the_data_gets_no_noise(config, monkeypatch):
    """The world model has not learnt what it does."""
    varied = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    monkeypatch.setattr(ActionWorldModelRewardModel, "action_deviation", lambda _: varied)
    config.exploration, config.num_episodes = 0.5, 3
    record(config)
    spread = np.std(open_dataset(config.root).hf_dataset.with_format("numpy")["action"][:], 0)
    assert np.array_equal(spread > 1e-3, varied.numpy() > 0)


def test_imagined_episodes_that_begin_in_saved_frames_are_recorded_too(config, small_dataset, tmp_path):
    """Their task and scene are unknown, their seed is that of the recording."""
    first = open_dataset(Path(small_dataset.root))[0]
    frame = (255 * first[IMAGE].permute(1, 2, 0)).byte().numpy()
    saved = {IMAGE: frame[None], "observation.state": first["observation.state"][None].numpy()}
    np.savez(tmp_path / "frames.npz", **saved, task=np.array([first["task"]]))
    config.env.dataset = StartFrames(frames=tmp_path / "frames.npz")
    config.num_episodes, config.seed = 2, 5
    record(config)
    columns = read_episodes(open_dataset(config.root)).columns
    assert columns[START_SEED].tolist() == [5, 6]
    assert START_SCENE not in columns


def test_an_episode_ends_with_the_k_frame_done(config):
    config.env.done_threshold = 0.0001
    record(config)
    table = read_episodes(open_dataset(config.root))
    assert table.length.tolist() == [2] * 7
    assert table.success.all()


def test_a_single_done_frame_is_no_success(config, monkeypatch):
    """Done in the second and in the fourth frame: two frames in a row are wanted."""
    step, count = ActionWorldModelRewardModel.step, itertools.count(1)

    def every_second(*args):
        return step(*args)._replace(done_logit=torch.full((3,), 20.0 if next(count) % 2 == 0 else -20.0))

    monkeypatch.setattr(ActionWorldModelRewardModel, "step", every_second)
    record(config)
    table = read_episodes(open_dataset(config.root))
    assert table.length.tolist() == [LENGTH] * 7
    assert not table.success.any()


def test_the_same_command_again_finds_it_complete_and_other_settings_are_refused(config, capsys):
    record(config)
    record(config)
    assert "already recorded: 7 episodes" in capsys.readouterr().out
    config.env.done_frames = 1
    with pytest.raises(ValueError, match=r"other settings \(done_frames 2 → 1\)"):
        record(config)


def test_another_policy_of_the_same_name_is_not_mixed_with_the_first(config):
    record(config)
    save_untrained_policy(Path(config.policy.pretrained_path), actions=7, constant=0.01)
    with pytest.raises(ValueError, match=r"other settings \(policy_content '\w+' → '\w+'\)"):
        record(config)


def test_frames_have_the_size_of_the_dataset_not_of_the_tokenizer(config, make_synthetic_dataset, tmp_path):
    """As policies see them, to whatever the tokenizer resizes them."""
    large = make_synthetic_dataset(tmp_path / "large", size=48)
    tokenizer = train_tokenizer(large.root, tmp_path / "tokenizer")
    model = run_training(action_config(tokenizer), large.root, tmp_path / "model")
    starts = StartFrames(root=str(large.root))
    config.env = replace(config.env, world_model_path=str(model), dataset=starts, fps=0)
    policy = save_untrained_policy(tmp_path / "large_policy", size=48, actions=7)
    config.policy = read_policy_config(str(policy), [])
    record(config)
    assert open_dataset(config.root).features[IMAGE]["shape"] == (48, 48, 3)


def test_a_start_that_comes_again_gets_other_noise(config, caplog):
    """The seventh episode begins as the first one does."""
    record(config)
    assert "there are 6 starts for more episodes" in caplog.text
    config.exploration, config.output_dir = 0.5, config.output_dir.with_name("explored")
    record(config)
    for root, alike in ((config.root.with_name("imagined"), True), (config.root, False)):
        actions = open_dataset(root).hf_dataset.with_format("numpy")["action"][:]
        assert (actions[:LENGTH] == actions[6 * LENGTH :]).all() == alike


def test_a_random_policy_does_something_else_when_a_start_comes_again(config, monkeypatch):
    """Each part has all six starts."""
    config.num_episodes, config.part_episodes = 12, 6
    monkeypatch.setattr(
        CnnPolicy, "select_action", lambda _, observation: 0.02 * torch.randn(len(observation[IMAGE]), 7)
    )
    record(config)
    actions = open_dataset(config.root).hf_dataset.with_format("numpy")["action"][:]
    first, second = np.split(np.asarray(actions), 2)
    assert not (first == second).all(1).any()


def test_a_planner_acts_as_a_policy(config, trained_models):
    """It has no checkpoint; its settings decide which recording the same command continues."""
    search = {"horizon": 4, "execute": 2, "samples": 4, "elites": 2, "iterations": 1, "knots": 2}
    config.num_episodes = 3
    config.policy = WmMpcConfig(
        world_model_path=str(trained_models["action_world_model"]), device="cpu", done_frames=2, **search
    )
    record(config)
    dataset = LeRobotDataset("local/imagined", root=config.root)
    actions = dataset.hf_dataset.with_format("numpy")["action"][:].reshape(3, LENGTH, 7)
    assert len({episode.tobytes() for episode in actions}) == 3
    assert (np.abs(actions[..., :2]) > 0).any()
    stored = config.recorded_content()["policy_content"]
    assert stored.keys() == {"world_model_path"}
    config.policy = replace(config.policy, samples=5)
    with pytest.raises(ValueError, match=r"other settings \(policy\.samples 4 → 5\)"):
        record(config)


def test_what_a_policy_does_out_of_range_is_reported(config, tmp_path, caplog):
    record(config)
    assert "out of range" not in caplog.text

    def acting(name: str, action: np.ndarray) -> PreTrainedConfig:
        saved = save_untrained_policy(tmp_path / name, actions=7, constant=action.tolist())
        return read_policy_config(str(saved), [])

    far = acting("far", 1.5 * np.array(ACTION_HIGH))
    record(replace(config, output_dir=tmp_path / "clipped", policy=far))
    assert "100.0 % of the components of the actions were out of range" in caplog.text
    other = replace(
        config, output_dir=tmp_path / "refused", policy=acting("units", 9 * np.array(ACTION_HIGH))
    )
    with pytest.raises(ValueError, match="use a policy with the same actions in the same units"):
        record(other)
    assert not other.output_dir.exists()


def test_a_policy_without_weights_is_refused(config):
    config.policy = CnnConfig(device="cpu")
    with pytest.raises(
        ValueError, match=r"policy\.type=cnn: would act with random weights; give a checkpoint"
    ):
        record(config)


def test_a_command_that_fails_at_once_leaves_nothing_behind(config, tmp_path):
    fits = config.policy
    config.policy = read_policy_config(str(save_untrained_policy(tmp_path / "other", actions=3)), [])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ValueError, match="has 3 action components, the environment 7"):
        record(config)
    assert sorted(tmp_path.iterdir()) == before
    config.policy = fits
    record(config)


def test_what_a_world_model_cannot_do_is_refused(config, make_synthetic_dataset, tmp_path):
    config.depth = True
    with pytest.raises(ValueError, match="depth=True: can be chosen in ManiSkill alone"):
        record(config)
    config.depth, config.env.dataset.branches = False, 1
    with pytest.raises(ValueError, match=r"env\.dataset\.branches=1: recorded episodes begin with first"):
        record(config)
    config.env.dataset.branches, config.policy = 0, None
    with pytest.raises(
        ValueError, match=r"env\.type=world_model: needs a policy; give `policy\.path`, or a planner"
    ):
        record(config)
    assert not config.root.exists()
