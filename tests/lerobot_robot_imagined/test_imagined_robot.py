"""The imagined robot in LeRobot's own commands: recording, replaying, a policy's rollouts."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots import make_robot_from_config
from lerobot.robots.config import RobotConfig
from lerobot.scripts.lerobot_record import record
from lerobot.scripts.lerobot_replay import replay
from lerobot.scripts.lerobot_rollout import rollout
from lerobot.scripts.lerobot_teleoperate import teleoperate
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils import keyboard_input

from lerobot_robot_imagined.config_imagined import ImaginedRobotConfig
from lerobot_robot_imagined.imagined import ImaginedRobot
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_world_model import DrivenEnv, StartFrames
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, ACTION_NAMES, FPS, STATE_NAMES
from tests.rl.checkpoints import save_untrained_policy

FOLDER = "calibration"


@TeleoperatorConfig.register_subclass("scripted")
@dataclass
class ScriptedTeleopConfig(TeleoperatorConfig):
    """A teleoperator that moves to and fro."""


class ScriptedTeleop(Teleoperator):
    """Sends a sine of 10 frames on the first axis."""

    config_class, name = ScriptedTeleopConfig, "scripted"
    action_features = dict.fromkeys(ACTION_NAMES, float)
    feedback_features: dict[str, Any] = {}  # noqa: RUF012
    is_connected = is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.step = 0

    def get_action(self) -> dict[str, float]:
        self.step += 1
        return {**dict.fromkeys(ACTION_NAMES, 0.0), "dx": 0.04 * float(np.sin(0.6 * self.step))}

    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
    def disconnect(self) -> None: ...


@pytest.fixture
def make_robot(small_dataset, trained_models, tmp_path) -> Callable[..., ImaginedRobot]:
    def make(**settings: Any) -> ImaginedRobot:
        config = ImaginedRobotConfig(
            world_model_path=str(trained_models["action_world_model"]),
            dataset=StartFrames(root=str(small_dataset.root)),
            calibration_dir=tmp_path / FOLDER,
            done_frames=1000,
            device="cpu",
            **settings,
        )
        robot = make_robot_from_config(config)
        robot.connect()
        return robot

    return make


@pytest.fixture
def flags(small_dataset, trained_models, tmp_path) -> list[str]:
    return [
        "--robot.type=imagined",
        f"--robot.world_model_path={trained_models['action_world_model']}",
        f"--robot.dataset.root={small_dataset.root}",
        "--robot.done_frames=1000",
        "--robot.device=cpu",
        f"--robot.calibration_dir={tmp_path / FOLDER}",
        "--play_sounds=false",
    ]


def recording(folder: Path, seconds: float, episodes: int) -> list[str]:
    return [
        "--dataset.repo_id=local/driven",
        f"--dataset.root={folder}",
        "--dataset.single_task=push",
        f"--dataset.num_episodes={episodes}",
        f"--dataset.episode_time_s={seconds}",
        "--dataset.reset_time_s=0",
        "--dataset.push_to_hub=false",
        "--dataset.video=false",
    ]


def run(command: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, *given: str) -> None:
    monkeypatch.setattr(sys, "argv", ["command", *given])
    for module in ("lerobot_record", "lerobot_teleoperate"):
        monkeypatch.setattr(f"lerobot.scripts.{module}.make_teleoperator_from_config", ScriptedTeleop)
    command()


def test_lerobot_knows_the_robot_and_makes_it(make_robot):
    assert "imagined" in RobotConfig.get_known_choices()
    robot = make_robot()
    assert isinstance(robot, ImaginedRobot)
    assert list(robot.action_features) == [*ACTION_NAMES]
    assert list(robot.observation_features) == [*STATE_NAMES, "third_view"]
    assert robot.observation_features["third_view"] == (32, 32, 3)


def test_it_shows_what_the_world_model_imagines(make_robot, small_dataset):
    robot, table = make_robot(first_start=2), read_episodes(small_dataset)
    first = robot.get_observation()
    np.testing.assert_allclose([first[name] for name in STATE_NAMES], table.state[table.start[2]], rtol=1e-5)
    assert first["third_view"].dtype == np.uint8
    reference = robot.env
    action = dict.fromkeys(ACTION_NAMES, 0.02)
    robot.send_action(action)
    seen = robot.get_observation()
    reference.reset(seed=[2])
    expected, *_ = reference.step(torch.full((1, 7), 0.02))
    image = (expected["observation.images.third_view"][0].permute(1, 2, 0) * 255).round().byte().numpy()
    np.testing.assert_array_equal(seen["third_view"], image)


def test_lerobot_record_writes_imagined_episodes_from_one_start_after_the_other(
    flags, small_dataset, tmp_path, monkeypatch
):
    folder = tmp_path / "driven"
    run(
        record,
        monkeypatch,
        *flags,
        *recording(folder, 0.5, 2),
        f"--dataset.fps={FPS}",
        "--robot.episode_time_s=0.5",
        "--teleop.type=scripted",
    )
    dataset, table = open_dataset(folder), read_episodes(small_dataset)
    found = read_episodes(dataset)
    assert len(found.length) == 2
    assert dataset.features["action"]["names"] == [*ACTION_NAMES]
    np.testing.assert_allclose(found.state[found.start], table.state[table.start[:2]], rtol=1e-5)
    assert np.ptp(found.action[:, 0]) > 0.02
    assert dataset[0]["observation.images.third_view"].shape == (3, 32, 32)


def test_lerobot_replay_repeats_a_recorded_episode(flags, small_dataset, monkeypatch, trained_models):
    last: list[Any] = []
    stop = ImaginedRobot.disconnect

    def disconnect(robot: ImaginedRobot) -> None:
        last.append(robot.get_observation())
        stop(robot)

    monkeypatch.setattr(ImaginedRobot, "disconnect", disconnect)
    run(
        replay,
        monkeypatch,
        *flags,
        "--robot.first_start=1",
        "--dataset.repo_id=local/synthetic",
        f"--dataset.root={small_dataset.root}",
        "--dataset.episode=1",
    )
    table = read_episodes(small_dataset)
    start, length = int(table.start[1]), int(table.length[1])
    actions = torch.from_numpy(table.action[start : start + length])
    imagined = DrivenEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(small_dataset.root)),
        episode_length=100,
        done_frames=100,
        device="cpu",
    ).create_tensor_env(1)
    imagined.reset(seed=[1])
    for action in actions:
        observation, *_ = imagined.step(action[None])
    np.testing.assert_allclose(
        [last[0][name] for name in STATE_NAMES], observation["observation.state"][0], rtol=1e-5
    )


def test_lerobot_teleoperate_drives_it(flags, monkeypatch):
    steps: list[Any] = []
    send = ImaginedRobot.send_action
    monkeypatch.setattr(
        ImaginedRobot, "send_action", lambda robot, action: steps.append(action) or send(robot, action)
    )
    given = [flag for flag in flags if not flag.startswith("--play_sounds")]
    run(teleoperate, monkeypatch, *given, "--teleop.type=scripted", f"--fps={FPS}", "--teleop_time_s=0.4")
    assert len(steps) > 3


def test_lerobot_rollout_runs_a_policy_in_it(flags, tmp_path, monkeypatch):
    """It passes on names that end in .pos alone."""
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    run(
        rollout,
        monkeypatch,
        *flags,
        "--robot.suffix=.pos",
        "--robot.episode_time_s=0.5",
        "--strategy.type=episodic",
        "--strategy.reset_to_initial_position=false",
        "--return_to_initial_position=false",
        f"--policy.path={policy}",
        f"--fps={FPS}",
        *recording(tmp_path / "rollout_driven", 0.5, 2),
        "--dataset.repo_id=local/rollout_driven",
    )
    dataset = LeRobotDataset("local/rollout_driven", root=tmp_path / "rollout_driven")
    assert dataset.num_episodes == 2
    assert dataset.features["action"]["names"] == [f"{name}.pos" for name in ACTION_NAMES]


def test_time_begins_the_next_episode_from_the_first_frame_that_was_shown_on(make_robot):
    robot = make_robot(episode_time_s=0.2)
    time.sleep(0.25)
    first = robot.get_observation()
    robot.send_action(dict.fromkeys(ACTION_NAMES, 0.05))
    assert robot.get_observation()["tcp_x"] != first["tcp_x"]
    assert robot.start == 0
    time.sleep(0.25)
    robot.get_observation()
    assert robot.start == 1


@pytest.mark.parametrize(("key", "start"), [("right", 1), ("left", 0), ("esc", 1)])
def test_a_key_ends_the_episode_once_the_command_has_noticed_it(make_robot, key, start):
    robot, events = make_robot(), {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    first = robot.get_observation()
    robot.send_action(dict.fromkeys(ACTION_NAMES, 0.05))
    keyboard_input.apply_recording_control(key, events)
    moved = robot.get_observation()
    assert moved["tcp_x"] != first["tcp_x"]
    assert events["exit_early"]
    events["exit_early"] = False
    again = robot.get_observation()
    assert robot.start == start
    assert (again["tcp_x"] == first["tcp_x"]) == (key == "left")
    assert robot.get_observation()["tcp_x"] == again["tcp_x"]


def test_keys_between_two_episodes_are_all_counted(make_robot):
    """One that ended an episode, and one while it was saved, which records the next again."""
    robot, events = make_robot(), {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    for key in ("right", "left"):
        keyboard_input.apply_recording_control(key, events)
        events["exit_early"] = False
    robot.get_observation()
    assert robot.start == 1


def test_an_episode_that_is_to_be_recorded_again_begins_again_whatever_follows(make_robot):
    robot, events = make_robot(), {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    for key in ("left", "right"):
        keyboard_input.apply_recording_control(key, events)
    events["exit_early"] = False
    robot.get_observation()
    assert robot.start == 0


def test_a_disconnected_robot_leaves_the_keys_to_lerobot(make_robot):
    before = keyboard_input.apply_recording_control
    robot = make_robot()
    assert keyboard_input.apply_recording_control != before
    robot.disconnect()
    assert keyboard_input.apply_recording_control == before


def test_it_stands_still_after_a_success(make_robot):
    robot = make_robot()
    robot.env.config.done_frames = 1
    step = robot.env.model.step
    robot.env.model.step = lambda *given: step(*given)._replace(done_logit=torch.tensor([20.0]))
    robot.send_action(dict.fromkeys(ACTION_NAMES, 0.02))
    still = robot.get_observation()
    robot.send_action(dict.fromkeys(ACTION_NAMES, -0.05))
    assert robot.get_observation()["tcp_x"] == still["tcp_x"]


def test_actions_are_kept_within_their_range_and_counted(make_robot, caplog):
    robot = make_robot()
    sent = robot.send_action(dict.fromkeys(ACTION_NAMES, 5.0))
    np.testing.assert_allclose(list(sent.values()), ACTION_HIGH, rtol=1e-6)
    robot.send_action(sent)
    robot.disconnect()
    assert "50.0 % of the components of the actions were out of range" in caplog.text


def test_a_keyboard_moves_it_and_its_gripper(make_robot):
    robot = make_robot()
    sent = robot.send_action({"delta_x": 1.0, "delta_y": -0.5, "delta_z": 0.0, "gripper": 2.0})
    np.testing.assert_allclose(
        [sent["dx"], sent["dy"], sent["dz"]], [ACTION_HIGH[0], ACTION_LOW[1] / 2, 0], 1e-6
    )
    assert sent["gripper"] == ACTION_HIGH[6]
    stays = robot.send_action({"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 1.0})
    assert stays["gripper"] == ACTION_HIGH[6]
    closed = robot.send_action({"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 0.0})
    assert closed["gripper"] == ACTION_LOW[6]


def test_actions_that_are_called_as_a_keyboards_are_taken_as_they_are(make_robot):
    """LeRobot's gym_manipulator records actions of these names, in the dataset's units."""
    robot = make_robot()
    names = ["delta_x", "delta_y", "delta_z", *robot.model.embodiment.action_names[3:]]
    robot.model.embodiment.action_names = names
    wanted = dict.fromkeys(names, 0.0) | {"delta_x": ACTION_HIGH[0] / 2}
    assert robot.send_action(wanted) == pytest.approx(wanted)


def test_what_cannot_be_is_refused(make_robot, trained_models):
    robot = make_robot()
    with pytest.raises(FieldError, match=r"need dy, dz, .* too; use a teleoperator whose actions are dx, dy"):
        robot.send_action({"dx": 0.0})
    robot.disconnect()
    robot.disconnect()
    with pytest.raises(ConnectionError, match="not connected"):
        robot.get_observation()
    with pytest.raises(FieldError, match=r"robot\.world_model_path=: is missing"):
        ImaginedRobotConfig()
