"""The whole command on data that is not ours: PushT, at the size `tiny`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.utils.constants import OBS_IMAGE

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_wmrl.data.episodes import ChosenEpisodes
from lerobot_wmrl.improve.findings import Findings
from lerobot_wmrl.improve.stages import ImproveConfig, Improvement
from tests.pusht import record_pusht
from tests.rl.checkpoints import save_untrained_policy

EPISODES = 3


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pusht") / "demonstrations"
    return record_pusht(root, f"--num_episodes={EPISODES}", "--steps=150", "--noise", "2")


def run(folder: Path, demonstrations: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own: it forks, which a test's process with its threads must not."""
    policy = folder / "policy"
    if not policy.exists():
        save_untrained_policy(policy, OBS_IMAGE, size=96, actions=2, constant=250.0)
    argv = [
        sys.executable, "-m", "lerobot_wmrl.scripts.improve",
        f"--policy.path={policy}", f"--dataset.root={demonstrations}", "--size=tiny", "--iterations=1",
        "--eval_episodes=2", f"--output_dir={folder / 'improve'}", *flags,
    ]  # fmt: skip
    return subprocess.run(argv, capture_output=True, text=True)


def test_with_a_real_environment_its_rollouts_are_learnt_from_and_success_is_measured_there(
    demonstrations: Path, tmp_path: Path
) -> None:
    real = ["--real_env.type=pusht", "--real_env.episode_length=20", "--rollouts=2"]
    first, folder = run(tmp_path, demonstrations, *real), tmp_path / "improve"
    assert first.returncode == 0, first.stdout[-3000:] + first.stderr[-3000:]
    assert "observation.image 96x96" in first.stdout
    assert "size tiny: about a minute on two cores, plus the time in pusht" in first.stdout
    assert "failures: 0. The world model will hardly tell them" in first.stdout
    report = (folder / "report.md").read_text()
    assert "Success in pusht: 0 % (0 of 2" in report
    assert "--dataset.more=" in report
    last = Path("checkpoints/last/pretrained_model")
    trained = json.loads((folder / "tokenizer" / last / "config.json").read_text())
    assert trained["tokenizer"]["frame_sizes"] == [[96, 96]]
    assert (folder / "rl" / last).exists()
    again = run(tmp_path, demonstrations, *real)
    assert "[6/6] Compare the policy before and after: done in" in again.stdout


def test_without_one_the_report_says_that_it_is_a_belief(demonstrations: Path, tmp_path: Path) -> None:
    done = run(tmp_path, demonstrations, "--dataset.episodes=[0,2]")
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    report = (tmp_path / "improve" / "report.md").read_text()
    assert "Success in imagination" in report
    assert "shows nothing about the real world" in report
    assert "from which it has learnt" in report
    assert "2 episodes, " in done.stdout
    assert report.count("dataset.episodes=[0,2]") == 5


@pytest.mark.parametrize(("flags", "message"), [
    (["--rollouts=2"], "--rollouts=2: are recorded in a real environment; give --real_env.type"),
    (["--size=huge"], "--size=huge: choose one of auto, tiny, demo, cpu"),
    (["--dataset.root=nowhere"], "no LeRobotDataset there"),
])  # fmt: skip
def test_bad_settings_are_named_and_nothing_is_made(
    flags: list[str], message: str, demonstrations: Path, tmp_path: Path
) -> None:
    refused = run(tmp_path, demonstrations, *flags)
    assert refused.returncode != 0
    assert message in refused.stderr
    assert not (tmp_path / "improve").exists()


@pytest.mark.parametrize(("longest", "clip", "length", "branches"), [(40, 42, 40, 0), (300, 100, 98, 3)])
def test_long_episodes_are_imagined_in_parts(
    longest: int, clip: int, length: int, branches: int, tmp_path: Path
) -> None:
    """From frames all over them, as many as it takes to cover them."""
    policy = CnnConfig(device="cpu", pretrained_path=tmp_path)
    found = Findings(
        [], [], ["top"], frame_side=96, episodes=40, held_out=2, fewest=40, longest=longest, held=2
    )
    improvement = Improvement(ImproveConfig(policy=policy, dataset=ChosenEpisodes("data")), found)
    commands = {stage.name: stage.command() for stage in improvement.stages()}
    assert f"--model.clip_length={clip}" in commands["world_model"]
    for stage in ("rl", "comparison"):
        assert {f"--env.episode_length={length}", f"--env.dataset.branches={branches}"} <= {*commands[stage]}
