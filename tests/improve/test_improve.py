"""The whole command on data that is not ours: PushT, at the size `tiny`."""

import json
import os
import shutil
import subprocess
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig, PushtEnv
from lerobot.scripts import lerobot_eval
from lerobot.utils.constants import OBS_IMAGE

from lerobot_wmrl.common.command_line import run_command
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import ChosenEpisodes, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.improve import plan as decisions
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import CLONED, FITTED, SFT
from lerobot_wmrl.scripts import train
from lerobot_wmrl.scripts.improve import improve
from tests.pusht import record_pusht
from tests.rl.checkpoints import save_untrained_policy

EPISODES = 3


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pusht") / "demonstrations"
    return record_pusht(root, f"--num_episodes={EPISODES}", "--steps=150", "--noise", "2")


def arguments(folder: Path, demonstrations: Path, *flags: str) -> list[str]:
    """Return those of the command, for an untrained policy."""
    policy = folder / "policy"
    if not policy.exists():
        save_untrained_policy(policy, OBS_IMAGE, size=96, actions=2, constant=250.0)
    return [
        f"--policy.path={policy}",
        f"--dataset.root={demonstrations}",
        "--size=tiny",
        "--iterations=1",
        "--selection_episodes=2",
        "--eval_episodes=2",
        f"--output_dir={folder / 'improve'}",
        *flags,
    ]


def run(folder: Path, demonstrations: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own: it forks, which a test's process with its threads must not."""
    given = arguments(folder, demonstrations, *flags)
    return subprocess.run(
        [sys.executable, "-m", "lerobot_wmrl.scripts.improve", *given], capture_output=True, text=True
    )


PUSHT = ("--real_env.type=pusht", "--real_env.episode_length=20")


@pytest.fixture(scope="module")
def improved(
    demonstrations: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """An improvement with PushT as the real environment: where it ran, and what it said."""
    folder = tmp_path_factory.mktemp("improved")
    return folder, run(folder, demonstrations, *PUSHT, "--rollouts=2")


def test_with_a_real_environment_its_rollouts_are_learnt_from_and_success_is_measured_there(
    demonstrations: Path, improved: tuple[Path, subprocess.CompletedProcess[str]]
) -> None:
    where, first = improved
    folder = where / "improve"
    assert first.returncode == 0, first.stdout[-3000:] + first.stderr[-3000:]
    assert "observation.image 96x96" in first.stdout
    assert "size tiny: about a minute on two cores, plus the time in pusht" in first.stdout
    report = (folder / "report.html").read_text()
    assert report.count("<td>0 % (0 of 2; 0–66 %)</td>") == 3, "three policies: RL has kept the one before"
    assert f"{FITTED}, against {CLONED}: 0 starts gained" in report
    assert f"{FITTED}, against {SFT}: 0 starts gained" in first.stdout
    assert "RL gained nothing: no checkpoint succeeded more often" in report
    assert "RL gained nothing" in first.stdout
    assert f"Policy to use: {SFT}, " in first.stdout, "none ever succeeds, and this one costs no training"
    assert "2 rollouts of the SFT policy in pusht, exploration 0.2: 0 succeed" in report
    assert "failures: 2. The world model will hardly tell them" in report
    assert "failures: " not in first.stdout.partition("[1/11]")[0], "there are rollouts to come"
    assert "Leave out columns" not in report
    merged = f"dataset.root={folder / 'merged'}"
    assert report.count(merged) == 8, (
        "cloning, tokenizer, world model, imagined starts thrice, driving, another round"
    )
    last = Path("checkpoints/last/pretrained_model")
    trained = json.loads((folder / "tokenizer" / last / "config.json").read_text())
    assert trained["tokenizer"]["frame_sizes"] == [[96, 96]]
    assert (folder / "distilled" / last).exists()
    again = run(where, demonstrations, *PUSHT, "--rollouts=2")
    assert "[11/11] Compare the policies: done in" in again.stdout


def test_its_world_model_plans_in_pusht(
    improved: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world_model = improved[0] / "improve" / "world_model"
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "lerobot-eval",
            "--policy.type=wm_mpc",
            f"--policy.world_model_path={world_model}",
            "--policy.horizon=4",
            "--policy.knots=2",
            "--policy.execute=2",
            "--policy.samples=4",
            "--policy.elites=2",
            "--policy.iterations=1",
            "--policy.done_frames=1",
            "--env.type=pusht",
            "--env.episode_length=4",
            "--eval.n_episodes=1",
            "--eval.batch_size=1",
            f"--output_dir={tmp_path}",
        ],
    )
    lerobot_eval.main()
    (found,) = json.loads((tmp_path / "eval_info.json").read_text())["per_task"]
    assert found["metrics"]["successes"] == [False]


def test_a_dyna_round_records_in_pusht(
    improved: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, out = improved[0] / "improve", tmp_path / "rl"
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "lerobot-wmrl-train",
            f"--policy.path={improved[0] / 'policy'}",
            "--env.type=world_model",
            f"--env.world_model_path={made / 'world_model'}",
            f"--env.dataset.root={made / 'merged'}",
            "--env.reward.type=general",
            "--env.reward.alpha=1",
            "--env.episode_length=3",
            "--iterations=2",
            "--num_envs=2",
            "--gate.action=off",
            *PUSHT,
            "--dyna.rounds=1",
            "--dyna.n_episodes=2",
            "--dyna.steps=1",
            "--dyna.batch_size=2",
            f"--output_dir={out}",
        ],
    )
    train.main()
    recorded = [read_episodes(open_dataset(out / "dyna" / "000001" / name)) for name in ("calm", "noisy")]
    assert [len(table.length) for table in recorded] == [1, 1]
    assert all(table.dataset.features[OBS_IMAGE]["shape"] == (96, 96, 3) for table in recorded)
    assert read_metrics(out)[-1]["real_steps/dyna"] == sum(int(table.length.sum()) for table in recorded)


def test_without_one_the_report_says_that_it_is_a_belief(demonstrations: Path, tmp_path: Path) -> None:
    done = run(tmp_path, demonstrations, "--dataset.episodes=[0,2]", "--policy.max_shift=1")
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    shifts = {
        folder: read_policy_config(str(tmp_path / folder), []).max_shift
        for folder in ("policy", "improve/policy", "improve/rl", "improve/distilled")
    }
    assert shifts == {"policy": 2, "improve/policy": 1, "improve/rl": 1, "improve/distilled": 1}
    report = (tmp_path / "improve" / "report.html").read_text()
    assert "Changes in imagination" in report
    assert "shows nothing about the real world" in report
    assert "most of which it has learnt from" in report
    assert "2 episodes, " in done.stdout
    assert report.count("dataset.episodes=[0,2]") == 7
    assert "failures: 0. The world model will hardly tell them" in done.stdout


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--rollouts=2"], "--rollouts=2: are recorded in a real environment; give --real_env.type"),
        (
            ["--real_env.type=pusht", "--rollouts=2", "--seed=949999"],
            "--seed=949999: must be from 0 to 949998",
        ),
        (
            ["--max_frames=9"],
            "--max_frames=9: limits rollouts in environments other than ManiSkill; leave it out",
        ),
        (
            ["--max_frames=9", "--rollouts=2", "--real_env.type=wmrl_maniskill"],
            "--max_frames=9: limits rollouts in environments other than ManiSkill; "
            "set --real_env.episode_length",
        ),
        (["--max_frames=0"], "--max_frames=0: must be at least 1"),
        (["--iterations=0"], "--iterations=0: must be at least 1"),
        (["--exploration=7"], "--exploration=7.0: must be between 0 and 1"),
        (
            ["--rollouts=2", "--real_env.type=wmrl_maniskill", "--real_env.split=ood"],
            "--real_env.split=ood: results are reported on unseen scenes",
        ),
        (
            ["--rollouts=2", "--real_env.type=wmrl_maniskill"],
            "they could not be merged; record it with lerobot-wmrl-record, or leave --rollouts out",
        ),
        (["--seed=1000000"], "--seed=1000000: must be from 0 to 999999"),
        (["--size=huge"], "--size=huge: choose one of auto, tiny, demo, cpu"),
        (["--dataset.root=nowhere"], "no LeRobotDataset there"),
        (["--check.root=nowhere"], "--check.root=nowhere: no LeRobotDataset there"),
        (
            ["--check.episodes=[0]"],
            "--check.episodes=[0]: is one of a dataset to check on, and none is named",
        ),
        (
            ["--real_env.type=wmrl_maniskill"],
            "the policy needs observation.image, which real_env does not have",
        ),
        (["--real_env.type=wmrl_maniskill", "--real_env.task=push,lift"], "--real_env.task=lift: unknown"),
        (
            ["--real_env.type=pusht", "--real_env.obs_type=environment_state_agent_pos"],
            "the policy needs observation.image, which real_env does not have",
        ),
    ],
)
def test_bad_settings_are_named_and_nothing_is_made(
    flags: list[str],
    message: str,
    demonstrations: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-improve", *arguments(tmp_path, demonstrations, *flags)])
    with pytest.raises(SystemExit) as stopped:
        run_command(improve, ImproveConfig, list)
    assert stopped.value.code == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "improve").exists()


def test_other_units_than_those_of_the_data_are_named_before_anything_is_made(
    demonstrations: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=5000.0)
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-improve", *arguments(tmp_path, demonstrations)])
    with pytest.raises(SystemExit):
        run_command(improve, ImproveConfig, list)
    assert "is 5000 on average, in the dataset it is between" in capsys.readouterr().err
    assert not (tmp_path / "improve").exists()


def test_a_dataset_that_has_changed_is_not_taken_for_the_one_before(
    demonstrations: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "data"
    shutil.copytree(demonstrations, root)
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=250.0)
    config = ImproveConfig(
        policy=read_policy_config(str(policy), []),
        dataset=ChosenEpisodes(str(root)),
        size="tiny",
        output_dir=tmp_path / "improve",
    )

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lerobot_wmrl.scripts.improve.run_stages", stop)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            improve(config)
    stats = root / "meta" / "stats.json"
    stats.write_text(json.dumps(json.loads(stats.read_text()), indent=1))
    with pytest.raises(ValueError, match=r"was begun with another content of dataset"):
        improve(config)


def note_process(policy: PreTrainedConfig, env: EnvConfig, starts: int) -> None:
    Path("process").write_text(str(os.getpid()))


def test_nothing_is_rendered_in_the_process_that_stages_are_forked_from(
    demonstrations: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With OpenGL, which MuJoCo renders with, a stage that renders would wait for ever."""
    monkeypatch.setattr(decisions, "check_real_env", note_process)
    monkeypatch.chdir(tmp_path)
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2)
    Plan.of(
        ImproveConfig(
            policy=read_policy_config(str(policy), []),
            dataset=ChosenEpisodes(str(demonstrations)),
            real_env=PushtEnv(),
            output_dir=tmp_path / "improve",
        )
    )
    assert int(Path("process").read_text()) != os.getpid()


def test_looking_at_the_data_leaves_the_settings_as_they_were(
    demonstrations: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the policy gets the dataset's cameras."""
    monkeypatch.setattr(decisions, "with_own_cameras", lambda policy, *_: deepcopy(policy))
    path = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=250.0)
    policy = read_policy_config(str(path), [])
    config = ImproveConfig(policy=policy, dataset=ChosenEpisodes(str(demonstrations)), output_dir=tmp_path)
    plan = Plan.of(config)
    assert config.policy is policy
    assert plan.config.policy is not policy
    assert plan.copies
