"""A scripted person's keys, and what lerobot-record keeps of them."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.scripts.lerobot_record import record

from experiments.person.script import SPEED, Hands, make_parser, write_script
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.maniskill.embodiment import ACTION_NAMES, FPS
from tests.rl.checkpoints import save_untrained_policy

FRAMES = 6


@pytest.fixture
def axes():
    moves = {"low": -1.0, "high": 1.0, "rest": 0.0, "springs": True}
    return [moves, {**moves, "rest": -1.0, "springs": False}]


def test_keys_move_at_one_speed_and_make_up_for_what_is_owed(axes):
    hands = Hands(axes)
    given = np.array([hands.press(np.array([SPEED / 4, -1.0])) for _ in range(8)])
    assert {*given[:, 0]} == {0.0, SPEED}
    assert given[:, 0].sum() == pytest.approx(2 * SPEED)


def test_an_axis_that_is_held_moves_there_step_by_step_and_stays(axes):
    hands = Hands(axes)
    given = [hands.press(np.array([0.0, 1.0]))[1] for _ in range(6)]
    assert given[0] == pytest.approx(-1 + SPEED)
    assert np.diff(given).max() == pytest.approx(SPEED)
    assert given[-1] == pytest.approx(given[-2], abs=SPEED)
    assert abs(given[-1] - 1) <= SPEED / 2


def test_an_axis_stays_in_its_range(axes):
    hands = Hands([{**axes[1], "rest": 0.5}])
    assert hands.press(np.array([2.0]))[0] == 1.0


def test_too_few_successes_are_said(small_dataset, world_model, policy, tmp_path):
    flags = [
        f"--world_model={world_model}",
        f"--dataset.root={small_dataset.root}",
        "--frames=3",
        f"--policy={policy}",
        "--episodes=7",
        "--done_threshold=1e-9",
        "--done_frames=3",
        f"--output_dir={tmp_path / 'person'}",
    ]
    with pytest.raises(SystemExit, match="--episodes=7: 6 of 6 drives succeed; ask for fewer"):
        write_script(make_parser().parse_args(flags))
    assert not (tmp_path / "person").exists()


@pytest.fixture
def world_model(trained_models) -> str:
    return str(trained_models["action_world_model"])


@pytest.fixture
def policy(tmp_path) -> str:
    return str(save_untrained_policy(tmp_path / "policy", actions=7))


@pytest.fixture
def script(small_dataset, world_model, policy, tmp_path) -> Path:
    """What the person does in two episodes; nearly everything is a success here."""
    folder = tmp_path / "person"
    flags = [
        f"--world_model={world_model}",
        f"--dataset.root={small_dataset.root}",
        f"--output_dir={folder}",
        f"--policy={policy}",
        "--episodes=2",
        f"--frames={FRAMES}",
        "--done_threshold=1e-9",
        "--done_frames=3",
    ]
    write_script(make_parser().parse_args(flags))
    return folder


def test_lerobot_record_keeps_what_the_person_does(script, small_dataset, world_model, tmp_path, monkeypatch):
    written = json.loads((script / "script.json").read_text())
    episodes = [int(each) for each in (script / "episodes.txt").read_text().split(",")]
    assert written["names"] == [*ACTION_NAMES]
    lengths = [len(actions) for actions in written["actions"]]
    calibration, folder = tmp_path / "calibration", tmp_path / "driven"
    flags = [
        "--robot.type=imagined",
        f"--robot.world_model_path={world_model}",
        "--robot.device=cpu",
        f"--robot.dataset.root={small_dataset.root}",
        f"--robot.dataset.episodes={episodes}",
        "--robot.done_threshold=1e-9",
        f"--robot.calibration_dir={calibration}",
        "--teleop.discover_packages_path=experiments.person",
        "--teleop.type=scripted_person",
        f"--teleop.script={script / 'script.json'}",
        f"--teleop.calibration_dir={calibration}",
        "--dataset.repo_id=local/driven",
        f"--dataset.root={folder}",
        "--dataset.single_task=push",
        "--dataset.num_episodes=2",
        f"--dataset.fps={FPS}",
        "--dataset.reset_time_s=0",
        "--dataset.push_to_hub=false",
        "--dataset.video=false",
        "--play_sounds=false",
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-record", *flags])
    record()
    found, source = read_episodes(open_dataset(folder)), read_episodes(small_dataset)
    np.testing.assert_allclose(found.state[found.start], source.state[source.start[episodes]], rtol=1e-5)
    assert found.length.tolist() == lengths
    np.testing.assert_allclose(found.action, np.concatenate(written["actions"]), rtol=1e-5)
