"""Environments of Hugging Face's hub, from a hub on the loopback: PushT, as somebody might publish it."""

import json
import re
import sys
from pathlib import Path

import pytest
import torch
from lerobot.envs.configs import IsaaclabArenaEnv, PushtEnv
from lerobot.scripts.lerobot_eval import main as lerobot_eval
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.envs.configuration_hub import HubEnv
from lerobot_wmrl.envs.lerobot_env import make_tensor_env, runs_in_processes
from lerobot_wmrl.improve.stages import list_stages
from tests.commands import run_here
from tests.hub_server import Hub, Repo
from tests.improve.made_up import improvement_of
from tests.rl.checkpoints import save_untrained_policy

STEPS = 3
FILE = f"""
import gymnasium as gym
import gym_pusht


def make_one():
    return gym.make("gym_pusht/PushT-v0", obs_type="pixels_agent_pos", max_episode_steps={STEPS})


def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([make_one] * n_envs)
"""
PATH = "someone/pusht"


def publish(hub: Hub, **files: str) -> None:
    """Put files at PATH, named without their ending."""
    repo = hub.repos["models", PATH] = Repo(private=False)
    repo.commit({f"{name}.py": text.encode() for name, text in files.items()})


def test_it_is_what_the_same_environment_is_without_the_hub(hub: Hub) -> None:
    publish(hub, env=FILE)
    ours = make_tensor_env(HubEnv(hub_path=PATH, trust_remote_code=True), 2, "cpu")
    known = make_tensor_env(PushtEnv(episode_length=STEPS), 2, "cpu")
    seen, wanted = ours.reset(seed=5)[0], known.reset(seed=5)[0]
    assert torch.equal(seen[OBS_STATE], wanted[OBS_STATE])
    for step in range(STEPS):
        actions = torch.full((2, 2), 100.0 * step)
        (seen, *outcome, info), (wanted, *expected, known_info) = ours.step(actions), known.step(actions)
        assert all(torch.equal(mine, theirs) for mine, theirs in zip(outcome, expected, strict=True))
        last, known_last = info.get("final_obs", seen), known_info.get("final_obs", wanted)
        assert torch.equal(last[OBS_IMAGE], known_last[OBS_IMAGE])
    assert info["final_info"]["episode_length"].tolist() == [STEPS] * 2


def test_any_file_of_any_revision_makes_it(hub: Hub) -> None:
    publish(hub, elsewhere=FILE)
    config = HubEnv(hub_path=f"{PATH}@main:elsewhere.py", trust_remote_code=True)
    assert make_tensor_env(config, 1, "cpu").max_episode_steps == STEPS
    assert not runs_in_processes(config), "it may lack what LeRobot asks of those in processes"


def test_no_code_runs_unasked() -> None:
    with pytest.raises(FieldError, match="the code of someone/pusht would run on this machine"):
        HubEnv(hub_path=PATH)
    with pytest.raises(FieldError, match="no environment is named"):
        make_tensor_env(HubEnv(trust_remote_code=True), 1, "cpu")


def test_lerobots_own_type_of_them_is_refused_where_it_cannot_be_trusted() -> None:
    with pytest.raises(FieldError, match=r"type=isaaclab_arena: its code lies on the hub.*choose another"):
        make_tensor_env(IsaaclabArenaEnv(), 1, "cpu")


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("someone/nothing", "cannot be had"),
        (f"{PATH}@main:nothing.py", "cannot be had: Could not find nothing.py"),
        ("no repository", "cannot be had: Repo id must"),
        (f"{PATH}@main:single.py", r"asked for 2 environments at once, its make_env made \[1\]"),
    ],
)
def test_what_cannot_be_made_is_named(hub: Hub, path: str, message: str) -> None:
    publish(hub, single=FILE + "\n\ndef make_env(n_envs=1, use_async_envs=False):\n    return make_one()\n")
    with pytest.raises(FieldError, match=message):
        HubEnv(hub_path=path, trust_remote_code=True).create_envs(2)


def test_commands_take_it_lerobots_too(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    publish(hub, env=FILE)
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=250.0)
    flags = [
        f"--policy.path={policy}",
        "--env.type=hub",
        f"--env.hub_path={PATH}",
        "--env.trust_remote_code=true",
        "--env.fps=10",
    ]
    run_here("lerobot-wmrl-record", *flags, "--num_episodes=2", f"--output_dir={tmp_path / 'rollouts'}")
    run_here("lerobot-wmrl-record", *flags, "--num_episodes=2", f"--output_dir={tmp_path / 'rollouts'}")
    assert "is already recorded: 2 episodes" in capsys.readouterr().out
    like = [f"--like.root={tmp_path / 'rollouts'}", "--video=false", f"--output_dir={tmp_path / 'images'}"]
    run_here("lerobot-wmrl-record", *flags, "--num_episodes=2", *like)
    shown = capsys.readouterr().err
    assert "record: 100%" in shown
    assert not re.search(rf"Map: .*/{STEPS} ", shown), "datasets' progress bar for each episode"
    recorded = open_dataset(tmp_path / "rollouts")
    assert (recorded.num_episodes, recorded.num_frames, recorded.fps) == (2, 2 * STEPS, 10)

    folder = tmp_path / "evaluated"
    counts = ["--eval.n_episodes=2", "--eval.batch_size=1", f"--output_dir={folder}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags, *counts])
    lerobot_eval()
    assert json.loads((folder / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_rl_trains_in_it_and_says_how_to_evaluate_there(
    hub: Hub, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    publish(hub, env=FILE)
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=250.0)
    flags = [
        f"--policy.path={policy}",
        "--env.type=hub",
        f"--env.hub_path={PATH}",
        "--env.trust_remote_code=true",
        "--num_envs=2",
        "--iterations=1",
        f"--output_dir={tmp_path / 'rl'}",
    ]
    for _ in range(2):
        run_here("lerobot-wmrl-train", *flags)
    again = capfd.readouterr().out.partition("already trained for 1 iterations")[2]
    assert f"--env.type=hub --env.hub_path={PATH} --env.trust_remote_code=true" in again


def test_improving_a_policy_there_is_planned_before_it_is_done(hub: Hub, tmp_path: Path) -> None:
    """The commands of the stages name the environment as the user did."""
    publish(hub, env=FILE)
    improvement = improvement_of(tmp_path)
    config = improvement.plan.config
    config.real_env, config.rollouts = HubEnv(hub_path=PATH, trust_remote_code=True, fps=10), 2
    recording = list_stages(improvement)[0].command()
    named = f"--env.type=hub --env.fps=10 --env.hub_path={PATH} --env.trust_remote_code=true"
    assert named in " ".join(recording)
