"""A drive is its start and its actions: what is seen, going back, replaying, and who acts."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import PushtEnv

from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.play.drive import Drive, RealEpisode
from lerobot_wmrl.play.drivers import copied
from lerobot_wmrl.play.visit import Visit
from lerobot_wmrl.play.world import load_world

IMAGE = "observation.images.third_view"


def some_actions(count: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [0.03 * torch.randn(1, 7, generator=generator).clamp(-1, 1) for _ in range(count)]


@pytest.fixture
def drive(world) -> Drive:
    return world.begin({"episode": 1, "frame": 4}, None)


def test_a_drive_begins_in_the_frame_that_is_asked_for(drive, small_dataset):
    table = read_episodes(small_dataset)
    np.testing.assert_allclose(drive.observation["observation.state"][0], table.state[table.start[1] + 4])
    assert drive.instruction == table.instructions[1]
    assert len(drive.recorded.actions) == table.length[1] - 4


def test_a_real_environment_has_one_task(world):
    several = WmrlManiSkillEnv(task="push,pull")
    with pytest.raises(
        FieldError, match=r"^real_env\.task=push,pull: a drive needs a single task; choose one"
    ):
        load_world(world.config, ChosenEpisodes(), None, several)


def test_a_policy_that_plans_is_refused(world):
    with pytest.raises(
        FieldError, match=r"^policy\.path=None: wm_mpc plans in a world model, as the page does"
    ):
        load_world(world.config, ChosenEpisodes(), WmMpcConfig(device="cpu"), None)


def test_a_real_environment_gets_actions_beyond_its_space_and_another_state_is_refused(world, monkeypatch):
    """As Aloha, which takes joint angles and says that they are between −1 and 1."""
    taken = []

    class Narrow(gym.Env):
        observation_space = gym.spaces.Dict(
            {
                "agent_pos": gym.spaces.Box(-9, 9, (3,), np.float32),
                "pixels": gym.spaces.Dict({"third_view": gym.spaces.Box(0, 255, (32, 32, 3), np.uint8)}),
            }
        )
        action_space = gym.spaces.Box(-0.01, 0.01, (7,), np.float32)
        task = task_description = "push"
        _max_episode_steps = 50

        def look(self):
            return {
                "agent_pos": np.zeros(3, np.float32),
                "pixels": {"third_view": np.zeros((32, 32, 3), np.uint8)},
            }

        def reset(self, *, seed=None, options=None):
            return self.look(), {}

        def step(self, action):
            taken.append(np.array(action))
            return self.look(), 0.0, False, False, {"is_success": False}

    made = gym.vector.SyncVectorEnv([Narrow])
    monkeypatch.setattr(PushtEnv, "create_envs", lambda *_, **__: {"narrow": {0: made}})
    monkeypatch.setattr(world, "real_env", PushtEnv())
    env = world.make_real_env()
    far = torch.tensor(world.model.embodiment.action_high)
    assert (far[:3] > 0.01).all()
    RealEpisode("narrow", env, 0).step(far[None])
    np.testing.assert_allclose(taken[0], far)
    with pytest.raises(FieldError, match=r"^real_env\.type=pusht: has a state of 3 components, .* learnt 8"):
        world.begin({"seed": 1}, env)


def test_going_back_and_doing_the_same_again_gives_the_same_frames(drive):
    actions = some_actions(8)
    first = [drive.step(action, "you") for action in actions]
    drive.rewind(3)
    assert drive.frame == 3
    assert [drive.step(action, "you") for action in actions[3:]] == first[3:]


def test_a_branch_leaves_the_frames_before_it_as_they_were(drive):
    views = [drive.step(action, "you") for action in some_actions(5)]
    drive.rewind(2)
    other = drive.step(torch.full((1, 7), 0.05), "you")
    assert drive.views[1:3] == views[:2]
    assert other["measured"] != views[2]["measured"]


def test_replaying_yields_what_was_seen_and_moves_nothing(drive):
    for action in some_actions(4):
        drive.step(action, "you")
    seen, views = drive.observation, list(drive.views)
    steps = list(drive.replay())
    assert [torch.from_numpy(step.action) for step in steps][2].equal(some_actions(4)[2][0])
    assert drive.views == views
    torch.testing.assert_close(drive.observation[IMAGE], seen[IMAGE], rtol=0, atol=0)
    following = drive.step(some_actions(5)[4], "you")
    drive.rewind(4)
    assert drive.step(some_actions(5)[4], "you") == following


def test_what_is_saved_is_the_action_that_was_imagined(drive):
    """Out of range it is clipped, as the environment does."""
    drive.step(torch.full((1, 7), 2.0), "you")
    (step,) = drive.replay()
    assert step.action.tolist() == drive.env.single_action_space.high.tolist()


def test_recorded_frames_are_beside_as_long_as_the_recorded_actions_are_taken(drive):
    assert drive.views[0]["beside"]["name"] == "recorded"
    taken = drive.step(torch.from_numpy(drive.recorded.actions[0])[None], "recorded")
    assert "beside" in taken
    assert "beside" not in drive.step(torch.zeros(1, 7), "you")


def test_an_episode_ends_with_success_and_is_not_driven_on(make_world):
    drive = make_world(end=True, done_frames=2).begin({"episode": 0, "frame": 0}, None)
    step = drive.env.model.step
    drive.env.model.step = lambda *args: step(*args)._replace(done_logit=torch.tensor([20.0]))
    try:
        views = [drive.step(action, "you") for action in some_actions(2)]
    finally:
        drive.env.model.step = step
    assert [view["ended"] for view in views] == ["", "success"]
    with pytest.raises(FieldError, match=r"step=2: the episode has ended \(success\); go back or restart"):
        drive.step(torch.zeros(1, 7), "you")
    drive.rewind(0)
    drive.step(torch.zeros(1, 7), "you")


@pytest.mark.parametrize("action", [[math.nan] * 7, [0.0] * 6])
def test_an_action_that_cannot_be_is_refused_and_changes_nothing(drive, action):
    with pytest.raises(FieldError, match=r"^action=.*must be 7 finite numbers"):
        drive.step(torch.tensor([action]), "you")
    assert drive.frame == 0


def test_goal_frames_and_similarity_are_shown_where_there_is_a_text_world_model(make_world):
    drive = make_world(text=True).begin({"episode": 0, "frame": 0, "instruction": "pull it back"}, None)
    assert drive.instruction == "pull it back"
    assert len(drive.goal) == 1
    assert 0 <= drive.step(torch.zeros(1, 7), "you")["measured"]["similarity"] <= 1


def test_every_driver_acts_and_the_recorded_one_as_recorded(world, saved, small_dataset):
    visit = Visit(world, saved)
    assert [*visit.drivers] == ["policy", "planner", "recorded"]
    visit.answer({"do": "begin", "episode": 2, "frame": 1})
    row = world.table.start[2] + 1
    view = visit.answer({"do": "step", "driver": "recorded"})["view"]
    np.testing.assert_allclose(view["action"], world.table.action[row])
    seen = visit.drive.observation
    expected = copied(world.policy).act(seen)
    view = visit.answer({"do": "step", "driver": "policy"})["view"]
    np.testing.assert_allclose(view["action"], expected[0], rtol=1e-5)
    assert visit.answer({"do": "step", "driver": "planner"})["view"]["driver"] == "planner"


def test_a_real_environment_that_has_moved_on_is_not_taken_for_that_of_the_drive(world, saved, monkeypatch):
    """A drive that cannot begin may have begun a real episode."""
    visit = Visit(world, saved)
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    assert visit.drive.synchronized
    monkeypatch.setattr(world, "real_env", PushtEnv())
    with pytest.raises(FieldError, match=r"^episode="):
        visit.answer({"do": "begin", "episode": 99})
    assert visit.drive.synchronized
    monkeypatch.setattr(world, "make_real_env", object)
    monkeypatch.setattr("lerobot_wmrl.play.world.RealEpisode", refuse)
    with pytest.raises(FieldError, match=r"^seed=3"):
        visit.answer({"do": "begin", "seed": 3})
    assert not visit.drive.synchronized


def refuse(kind: str, env: object, seed: int) -> None:
    raise FieldError("seed", seed, "cannot be")


def test_a_plan_is_made_anew_after_somebody_else_has_acted(world, saved):
    visit = Visit(world, saved)
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    visit.answer({"do": "step", "driver": "planner"})
    planned = len(visit.drivers["planner"].plan)
    visit.answer({"do": "step", "driver": "you", "action": [0.04] * 7})
    visit.answer({"do": "step", "driver": "planner"})
    assert len(visit.drivers["planner"].plan) == planned


def test_of_chosen_episodes_the_page_offers_no_others(world, small_dataset):
    chosen = ChosenEpisodes(str(small_dataset.root), episodes=[4, 2])
    some = load_world(world.config, chosen, None, None)
    assert [each["success"] for each in some.description()["episodes"]] == [False, True]
    for index, episode in enumerate((2, 4)):
        drive = some.begin({"episode": index, "frame": 2}, None)
        whole = world.begin({"episode": episode, "frame": 2}, None)
        assert (drive.recorded.images[:1] == whole.recorded.images[:1]).all()
    with pytest.raises(FieldError, match=r"episode=2: .*"):
        some.begin({"episode": 2, "frame": 0}, None)
    with pytest.raises(FieldError, match=r"dataset\.episodes=\[7\]: there is no episode 7"):
        load_world(world.config, ChosenEpisodes(str(small_dataset.root), episodes=[7]), None, None)


def test_the_recorded_episode_ends(world, saved):
    visit = Visit(world, saved)
    visit.answer({"do": "begin", "episode": 0, "frame": 10})
    visit.answer({"do": "step", "driver": "recorded"})
    with pytest.raises(FieldError, match="the recorded episode is over"):
        visit.answer({"do": "step", "driver": "recorded"})


def test_copies_of_a_policy_share_their_weights_and_nothing_else(world):
    policy = world.policy
    other = copied(policy)
    pairs = zip(policy.policy.parameters(), other.policy.parameters(), strict=True)
    assert all(a is b for a, b in pairs)
    assert other.policy is not policy.policy
    assert other.preprocessor is not policy.preprocessor
    assert other.postprocessor is not policy.postprocessor


def test_saved_episodes_are_a_dataset_that_grows(world, saved, small_dataset):
    """Across visits and restarts; what was driven is in it, and success only where it was."""
    for index, success in enumerate([True, False]):
        place = type(saved)(saved.folder, saved.robot, saved.held)
        visit = Visit(world, place)
        visit.answer({"do": "begin", "episode": index, "frame": 0})
        for action in some_actions(5):
            visit.answer({"do": "step", "driver": "you", "action": action[0].tolist()})
        assert visit.answer({"do": "save", "success": success})["saved"] == index
    dataset = LeRobotDataset("local/driven", root=saved.folder)
    table = read_episodes(dataset)
    assert table.length.tolist() == [5, 5]
    assert table.success.tolist() == [True, False]
    assert table.done.sum() == 3
    np.testing.assert_allclose(table.action[:5], torch.cat(some_actions(5)), rtol=1e-6)
    assert dataset[5]["task"] == read_episodes(small_dataset).instructions[1]
    first = world.begin({"episode": 1, "frame": 0}, None).observation[IMAGE][0]
    torch.testing.assert_close(dataset[5][IMAGE], first, atol=0.6 / 255, rtol=0)
    assert dataset.fps == 25


def test_nothing_is_saved_of_nothing(world, saved):
    visit = Visit(world, saved)
    with pytest.raises(FieldError, match="do=save: nothing has begun; begin first"):
        visit.answer({"do": "save"})
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    with pytest.raises(FieldError, match="nothing has been driven yet"):
        visit.answer({"do": "save"})
    assert not saved.folder.exists()


def test_a_save_that_is_interrupted_loses_no_episode(world, saved, monkeypatch):
    visit = Visit(world, saved)
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    visit.answer({"do": "step", "driver": "you", "action": [0.0] * 7})
    visit.answer({"do": "save", "success": True})
    monkeypatch.setattr(LeRobotDataset, "finalize", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        visit.answer({"do": "save", "success": True})
    monkeypatch.undo()
    assert type(saved)(saved.folder, saved.robot, saved.held).count == 1
    visit.answer({"do": "save", "success": False})
    assert read_episodes(LeRobotDataset("local/driven", root=saved.folder)).success.tolist() == [True, False]


def test_a_replacement_that_was_cut_between_its_two_moves_is_put_back(world, saved):
    visit = Visit(world, saved)
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    visit.answer({"do": "step", "driver": "you", "action": [0.0] * 7})
    visit.answer({"do": "save", "success": True})
    saved.folder.replace(saved.folder.with_name(".driven.old"))
    assert type(saved)(saved.folder, saved.robot, saved.held).count == 1
    saved.folder.replace(saved.folder.with_name(".driven.old"))
    visit.answer({"do": "save", "success": False})
    table = read_episodes(LeRobotDataset("local/driven", root=saved.folder))
    assert table.success.tolist() == [True, False], "also by a server that was running meanwhile"


def test_two_servers_can_save_into_one_folder(world, saved):
    visits = [Visit(world, each) for each in (saved, type(saved)(saved.folder, saved.robot, saved.held))]
    for visit in visits:
        visit.answer({"do": "begin", "episode": 0, "frame": 0})
        visit.answer({"do": "step", "driver": "you", "action": [0.0] * 7})

    def save_twice(visit: Visit) -> list[int]:  # a server answers in one thread
        return [visit.answer({"do": "save", "success": True})["saved"] for _ in range(2)]

    with ThreadPoolExecutor() as pool:
        saved_as = [index for indices in pool.map(save_twice, visits) for index in indices]
    assert sorted(saved_as) == [0, 1, 2, 3]
    assert read_episodes(LeRobotDataset("local/driven", root=saved.folder)).length.tolist() == [1] * 4


def test_a_folder_with_other_columns_is_refused_and_kept(world, saved, make_synthetic_dataset):
    make_synthetic_dataset(saved.folder, episodes=1)
    visit = Visit(world, type(saved)(saved.folder, saved.robot, saved.held))
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    visit.answer({"do": "step", "driver": "you", "action": [0.0] * 7})
    with pytest.raises(FieldError, match=r"^output_dir=.*; choose a new folder"):
        visit.answer({"do": "save"})
    assert read_episodes(LeRobotDataset("local/synthetic", root=saved.folder)).length.tolist() == [11]


def test_episodes_of_another_robot_are_not_mixed(world, saved, make_synthetic_dataset):
    make_synthetic_dataset(saved.folder, episodes=1)
    with pytest.raises(FieldError, match=r"^output_dir=.*has learnt 10, use|^output_dir=.*frames a second"):
        type(saved)(saved.folder, replace(saved.robot, fps=10), saved.held)


def test_an_empty_folder_and_a_link_hold_episodes_like_any_other(world, saved, tmp_path):
    real = tmp_path / "elsewhere"
    real.mkdir()
    saved.folder.symlink_to(real)
    place = type(saved)(saved.folder, saved.robot, saved.held)
    visit = Visit(world, place)
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    visit.answer({"do": "step", "driver": "you", "action": [0.0] * 7})
    for index in range(2):
        assert visit.answer({"do": "save", "success": True})["saved"] == index
    assert saved.folder.is_symlink()
    assert type(saved)(saved.folder, saved.robot, saved.held).count == 2


@pytest.mark.parametrize("at", [1, 4])
@pytest.mark.parametrize("act", ["rewind", "replay", "step"])
def test_an_error_midway_loses_nothing(drive, act, at, monkeypatch):
    """The drive is imagined anew the next time: when the picture fails, imagination has moved on already."""
    actions = some_actions(6)
    views = [drive.step(action, "you") for action in actions[:5]]
    decode, left = drive.env.model.decode, [1 if act == "step" else at]

    def failing(*given):
        left[0] -= 1
        if left[0] == 0:
            raise RuntimeError("out of memory")
        return decode(*given)

    monkeypatch.setattr(drive.env.model, "decode", failing)
    with pytest.raises(RuntimeError, match="out of memory"):
        {
            "rewind": lambda: drive.rewind(5),
            "replay": lambda: list(drive.replay()),
            "step": lambda: drive.step(actions[5], "you"),
        }[act]()
    assert drive.views[1:] == views
    following = drive.step(actions[5], "you")
    drive.rewind(0)
    assert [drive.step(action, "you") for action in actions] == [*views, following]


def test_success_is_judged_by_the_last_frames_where_the_episode_goes_on(make_world, saved):
    """And labelled in them alone."""
    world = make_world(done_frames=2)
    visit = Visit(world, type(saved)(saved.folder, saved.robot, world.criterion.frames))
    visit.answer({"do": "begin", "episode": 0, "frame": 0})
    step = world.models.model.step
    logits = iter([-20.0, -20.0, 20.0, 20.0, 20.0])
    world.models.model.step = lambda *args: step(*args)._replace(done_logit=torch.tensor([next(logits)]))
    try:
        for _ in range(5):
            assert not visit.answer({"do": "step", "driver": "you", "action": [0.0] * 7})["view"]["ended"]
    finally:
        world.models.model.step = step
    assert visit.answer({"do": "save"})["success"]
    table = read_episodes(LeRobotDataset("local/driven", root=saved.folder))
    assert table.done.tolist() == [False, False, False, True, True]


def test_axes_spring_back_where_their_range_is_centred_and_grippers_stay(world):
    axes = world.axes()
    assert [axis["name"] for axis in axes if axis["springs"]] == ["dx", "dy", "dz", "droll", "dpitch", "dyaw"]
    assert all(axis["low"] <= axis["rest"] <= axis["high"] for axis in axes)
