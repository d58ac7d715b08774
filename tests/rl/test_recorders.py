"""A policy is recorded in an environment that nobody here has built: PushT, by LeRobot's own plugin."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gym_pusht.envs.pusht import PushTEnv
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig, PushtEnv
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import OBS_IMAGE

from lerobot_wmrl.common.constants import KINDS, POLICY, START_KIND
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.embodiment import Embodiment, check_same_robot
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.envs import rollout_recorder
from lerobot_wmrl.envs.rollout_recorder import RolloutRecorder, robot_of
from lerobot_wmrl.evaluation.policy_rollouts import evaluate_policy
from lerobot_wmrl.rl.recorders import EnvRecorder
from tests.rl.checkpoints import loaded, save_untrained_policy

STEPS, AIM = 5, 250.0
ROBOT = Embodiment(
    fps=10,
    action_names=["x", "y"],
    action_low=[0.0, 0.0],
    action_high=[512.0, 512.0],
    state_names=["agent_x", "agent_y"],
)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that always goes to the same place."""
    folder = tmp_path_factory.mktemp("pusht")
    save_untrained_policy(folder / "pretrained_model", OBS_IMAGE, size=96, actions=2, constant=AIM)
    return folder


def recorded(checkpoint: Path, folder: Path, seed: int = 7, exploration: float = 0.0) -> EpisodeTable:
    recorder = EnvRecorder(PushtEnv(episode_length=STEPS), ROBOT, "cpu")
    recorder.record(checkpoint, 2, seed, folder, exploration)
    return read_episodes(open_dataset(folder))


def test_rows_are_what_the_policy_saw_and_did(checkpoint: Path, tmp_path: Path) -> None:
    table = recorded(checkpoint, tmp_path / "rollouts")
    assert table.length.tolist() == [STEPS, STEPS]
    assert np.allclose(table.action, AIM)
    assert (table.has_labels, table.success.any()) == (True, False)
    assert set(table.column(START_KIND)) == {KINDS.index(POLICY)}
    check_same_robot(ROBOT, table.dataset.meta)
    assert tuple(table.dataset.features[OBS_IMAGE]["shape"]) == (96, 96, 3)
    first = table.dataset[0][OBS_IMAGE]
    assert 0.5 < first.mean() <= 1
    moved = np.linalg.norm(table.state[STEPS - 1] - table.state[0])
    assert moved > 1, "the state of the second frame follows the first action"


def test_rewards_are_the_environments(checkpoint: Path, tmp_path: Path) -> None:
    table = recorded(checkpoint, tmp_path / "rollouts")
    rewards = np.ravel(table.dataset.hf_dataset.with_format("numpy")["next.reward"])
    (env,) = PushtEnv(episode_length=STEPS).create_envs(1)["pusht"].values()
    env.reset(seed=7)
    for action, reward in zip(table.action[:STEPS], rewards, strict=False):
        assert env.step(action[None])[1][0] == pytest.approx(reward)
    env.close()


def test_seeds_decide_the_start_and_noise_stays_in_range(checkpoint: Path, tmp_path: Path) -> None:
    first = recorded(checkpoint, tmp_path / "first")
    again = recorded(checkpoint, tmp_path / "again")
    other = recorded(checkpoint, tmp_path / "other", seed=8, exploration=1.0)
    assert np.array_equal(first.state, again.state)
    assert np.array_equal(first.state[STEPS], other.state[0]), "episode i starts from seed + i"
    assert other.action.std() > 1
    assert (other.action >= 0).all()
    assert (other.action <= 512).all()


def test_a_policy_that_draws_its_actions_draws_the_same_from_a_seed(checkpoint: Path, tmp_path: Path) -> None:
    """As flows and diffusion do. What is drawn elsewhere stays as it was."""
    made = []
    for name in ("first", "again"):
        config = read_policy_config(str(checkpoint / "pretrained_model"), [])
        recorder = RolloutRecorder(PushtEnv(episode_length=STEPS), config, ROBOT)
        chosen = recorder.policy.policy.select_action
        recorder.policy.policy.select_action = lambda seen, chosen=chosen: chosen(seen) + torch.randn(1, 2)
        torch.manual_seed(len(name))
        expected = torch.rand(1)
        torch.manual_seed(len(name))
        recorder.record(tmp_path / name, [7, 8], lambda success: None)
        assert torch.equal(torch.rand(1), expected)
        recorder.close()
        made.append(read_episodes(open_dataset(tmp_path / name)).action)
    assert np.array_equal(*made)
    assert not np.array_equal(made[0][:STEPS], made[0][STEPS:])


def test_videos_that_lerobot_cannot_encode_alike_are_refused_before_a_rollout(checkpoint: Path) -> None:
    config = read_policy_config(str(checkpoint / "pretrained_model"), [])
    videos = {"dtype": "video", "shape": (96, 96, 3), "info": {"video.codec": "vp9"}}
    like: Any = SimpleNamespace(features={OBS_IMAGE: videos}, root="data/web", fps=10, robot_type=None)
    with pytest.raises(FieldError, match=r"^like\.root=data/web: its videos cannot be encoded alike .*vp9"):
        RolloutRecorder(PushtEnv(episode_length=STEPS), config, ROBOT, like=like)


def test_what_the_policy_does_out_of_range_is_reported_and_noise_is_not(
    checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorded(checkpoint, tmp_path / "noise", exploration=1.0)
    assert "out of range" not in caplog.text
    narrow = replace(ROBOT, action_high=[512.0, AIM - 1])
    EnvRecorder(PushtEnv(episode_length=STEPS), narrow, "cpu").record(checkpoint, 1, 7, tmp_path / "narrow")
    assert "50.0 % of the components of the actions were out of range" in caplog.text


def test_what_a_policy_does_after_its_episode_is_not_counted(
    checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot's rollout goes on until the last environment has ended."""

    def first_ends_early(*given: Any, **settings: Any) -> Any:
        taken, seen = rollout(*given, **settings), given[4].__self__
        taken["done"][0, 1] = True
        seen.clipped = [torch.full((2,), float(step >= 2)) for step in range(STEPS)]
        return taken

    monkeypatch.setattr(rollout_recorder, "rollout", first_ends_early)
    recorder = EnvRecorder(PushtEnv(episode_length=STEPS), ROBOT, "cpu", num_envs=2)
    recorder.record(checkpoint, 2, 7, tmp_path / "rollouts")
    assert read_episodes(open_dataset(tmp_path / "rollouts")).length.tolist() == [2, STEPS]
    assert "42.9 % of the components" in caplog.text, "three of seven steps"


@EnvConfig.register_subclass("test_next_step")
@dataclass
class NextStepPusht(PushtEnv):
    """PushT in a vector environment that resets in the step after an end, as LIBERO's."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        made = PushtEnv(episode_length=STEPS).create_envs(n_envs, use_async_envs)
        for tasks in made.values():
            tasks[0].autoreset_mode = AutoresetMode.NEXT_STEP
        return made


def test_a_finished_episode_is_not_reset_while_the_others_go_on(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In LIBERO every reset takes another start."""
    reset, step, resets = PushTEnv.reset, PushTEnv.step, []

    def noted(self: PushTEnv, seed: int | None = None, options: Any = None) -> Any:
        resets.append(seed)
        self.ends = seed == 7
        return reset(self, seed=seed, options=options)

    def ended(self: PushTEnv, action: np.ndarray) -> Any:
        seen, reward, terminated, truncated, info = step(self, action)
        return seen, reward, terminated or self.ends, truncated, info

    monkeypatch.setattr(PushTEnv, "reset", noted)
    monkeypatch.setattr(PushTEnv, "step", ended)
    recorder = EnvRecorder(NextStepPusht(episode_length=STEPS), ROBOT, "cpu", num_envs=2)
    recorder.record(checkpoint, 2, 7, tmp_path / "rollouts")
    assert read_episodes(open_dataset(tmp_path / "rollouts")).length.tolist() == [1, STEPS]
    assert [seed for seed in resets if seed is not None] == [7, 8]
    assert None not in resets[resets.index(7) :]


def test_success_that_holds_is_recorded_whenever_other_episodes_end(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot's rollout takes what goes on for unsolved in a step in which anything ends."""
    reset, step = PushTEnv.reset, PushTEnv.step

    def noted(self: PushTEnv, seed: int | None = None, options: Any = None) -> Any:
        self.ends, self.steps = seed == 7 if seed is not None else self.ends, 0
        return reset(self, seed=seed, options=options)

    def solved(self: PushTEnv, action: np.ndarray) -> Any:
        seen, reward, _, truncated, info = step(self, action)
        self.steps += 1
        success = self.steps >= 2
        return seen, reward, success and self.ends, truncated, {**info, "is_success": success}

    monkeypatch.setattr(PushTEnv, "reset", noted)
    monkeypatch.setattr(PushTEnv, "step", solved)
    recorder = EnvRecorder(PushtEnv(episode_length=STEPS), ROBOT, "cpu", num_envs=2)
    recorder.record(checkpoint, 2, 7, tmp_path / "rollouts")
    table = read_episodes(open_dataset(tmp_path / "rollouts"))
    assert table.length.tolist() == [2, STEPS]
    assert table.done.tolist() == [False, True, *[False, True, True, True, True]]


def test_actions_may_go_as_far_as_those_of_the_same_robots_dataset(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """LeRobot's Aloha takes joint angles, and says that they are from -1 to 1."""
    features = {"action": {"dtype": "float32", "shape": (2,), "names": ["elbow", "gripper"]}}
    dataset = LeRobotDataset.create("local/joints", 50, features, root=tmp_path / "joints")
    for elbow in np.linspace(-0.5, 1.16, 20, dtype=np.float32):
        dataset.add_frame({"action": np.array([elbow, 0], np.float32), "task": "insert"})
    dataset.save_episode()
    dataset.finalize()
    env = SimpleNamespace(single_action_space=Box(-1, 1, (2,)))
    robot = robot_of(PushtEnv(), env, dataset.meta)
    assert robot.action_names == ["elbow", "gripper"]
    assert (robot.action_low, robot.action_high) == ([-1, -1], [pytest.approx(1.16), 1])
    assert "elbow -0.5 to 1.16 (in pusht -1 to 1). Are they in the same units?" in caplog.text
    dataset.meta.features["action"]["info"] = {"low": [-2.0, 0.0], "high": [2.0, 1.0]}
    assert robot_of(PushtEnv(), env, dataset.meta).action_high == [2, 1], "what it states goes before both"


def test_what_is_recorded_is_not_recorded_again_and_is_entered_in_the_ledger(
    checkpoint: Path, tmp_path: Path
) -> None:
    ledger = tmp_path / "budget.json"
    ledger.write_text(json.dumps({"limits": {"demonstrations": 0, "rollouts": 2, "play": 0}}))
    recorder = EnvRecorder(PushtEnv(episode_length=STEPS), ROBOT, "cpu", ledger)
    (tmp_path / ".rollouts.partial").mkdir()
    for _ in range(2):
        recorder.record(checkpoint, 2, 7, tmp_path / "rollouts")
    with pytest.raises(ValueError, match="rollouts"):
        recorder.record(checkpoint, 2, 17, tmp_path / "more")


def test_success_is_measured_there(checkpoint: Path) -> None:
    policy = loaded(checkpoint / "pretrained_model")
    found = evaluate_policy(PushtEnv(episode_length=STEPS), policy, episodes=3, seed=7, num_envs=2)
    assert (found.successes, found.steps) == ([False] * 3, 4 * STEPS)
