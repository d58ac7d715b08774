"""What the trainings refuse to learn from: what is reported on, and, under a budget, what is not in it."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import Ledger, Limits
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.rl import dyna, recorders
from lerobot_wmrl.rl.budget import check_data
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.scripts.train import main as train
from lerobot_wmrl.scripts.train_world_model import main as train_world_model
from tests.rl.checkpoints import save_untrained_policy
from tests.scripts.point_config import PointConfig

TOKENIZER = [
    "--model.type=frame_tokenizer",
    "--model.device=cpu",
    "--model.tokenizer.image_size=32",
    "--model.tokenizer.widths=[8,16]",
    "--model.tokenizer.levels=[5,4]",
    "--dataset.root={data}",
    "--steps=1",
    "--batch_size=2",
]
SHORT = [
    "--algorithm.type=ppo",
    "--num_envs=2",
    "--iterations=2",
    "--save_freq=2",
    "--algorithm.value_iterations=0",
]
STARTS = "--env.dataset.root={data}"
IMAGINED = [
    "--policy.path={pushing}",
    "--env.type=world_model",
    "--env.world_model_path={action_world_model}",
    "--env.reward.type=general",
    "--env.reward.alpha=1",
    "--env.episode_length=4",
    "--env.done_frames=1",
    "--env.device=cpu",
    *SHORT,
]
SIMULATED = ["--policy.path={pointing}", "--env.type=test_point", *SHORT]
UNCHECKED = "--gate.action=warn"
REAL = ["--real_env.type=wmrl_maniskill", "--real_env.image_size=32"]
UNKNOWN = "={other}: 4 of 4 episodes are not in the budget"


@pytest.fixture(scope="module")
def other(make_synthetic_dataset: Callable[..., LeRobotDataset], tmp_path_factory: Any) -> Path:
    """Four episodes like those of the budget, from other seeds."""
    root = tmp_path_factory.mktemp("other") / "other"
    make_synthetic_dataset(root, episodes=4)
    for episode in range(4):
        change(root, episode, "start.seed", 100 + episode)
    return root


@pytest.fixture(scope="module")
def reported(make_synthetic_dataset: Callable[..., LeRobotDataset], tmp_path_factory: Any) -> Path:
    """Episode 2 has an evaluation seed, and episode 4 an unseen scene."""
    root = tmp_path_factory.mktemp("reported") / "reported"
    make_synthetic_dataset(root)
    change(root, 2, "start.seed", 1_000_007)
    change(root, 4, "start.scene", scenes_of("ood")[0].index)
    return root


def change(root: Path, episode: int, column: str, value: int) -> None:
    import pandas as pd

    for path in (root / "data").rglob("*.parquet"):
        rows = pd.read_parquet(path)
        rows.loc[rows["episode_index"] == episode, column] = value
        rows.to_parquet(path)


@pytest.fixture
def paths(
    trained_models: dict[str, Path],
    small_dataset: LeRobotDataset,
    other: Path,
    reported: Path,
    tmp_path: Path,
) -> dict[str, Any]:
    """What flags may name; the budget knows the episodes of `data`, six of its eight demonstrations."""
    ledger = Ledger.create(tmp_path / "budget.json", Limits(demonstrations=8, rollouts=5))
    ledger.charge(read_episodes(small_dataset))
    return {
        **trained_models,
        "data": small_dataset.root,
        "other": other,
        "reported": reported,
        "out": tmp_path / "out",
        "budget": ledger.path,
        "pointing": save_untrained_policy(tmp_path / "pointing"),
        "pushing": save_untrained_policy(tmp_path / "pushing", actions=7),
    }


@pytest.fixture
def run(paths: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Any:
    """A command in this process, with an output folder of its own."""

    def call(command: Callable[[], None], *flags: str) -> Path:
        given = [flag.format(**paths) for flag in (*flags, "--output_dir={out}")]
        monkeypatch.setattr(sys, "argv", ["command", *given])
        command()
        return paths["out"]

    return call


@pytest.mark.parametrize(
    ("command", "flags", "message"),
    [
        (train_world_model, [*TOKENIZER, "--dataset.root={other}"], "--dataset.root" + UNKNOWN),
        (train_world_model, [*TOKENIZER, "--dataset.more=[{other}]"], "--dataset.more" + UNKNOWN),
        (train, [*IMAGINED, UNCHECKED, "--env.dataset.root={other}"], "--env.dataset.root" + UNKNOWN),
        (train, [*IMAGINED, STARTS, "--gate.dataset.root={other}"], "--gate.dataset.root" + UNKNOWN),
        (
            train,
            [*IMAGINED, STARTS, UNCHECKED, "--selection.dataset.root={other}"],
            "--selection.dataset.root" + UNKNOWN,
        ),
        (
            train,
            [*IMAGINED, STARTS, UNCHECKED, "--dyna.rounds=1", "--dyna.dataset.roots=[{other}]"],
            "--dyna.dataset.roots" + UNKNOWN,
        ),
        (
            train,
            [
                *IMAGINED,
                STARTS,
                UNCHECKED,
                "--dyna.rounds=1",
                "--dyna.dataset.roots=[]",
                "--dyna.learnt.root={other}",
            ],
            "--dyna.learnt.root" + UNKNOWN,
        ),
        (train, [*IMAGINED, UNCHECKED, "--env.dataset.resets=2"], "--env.dataset.resets=2: under a budget"),
        (train, [*IMAGINED, UNCHECKED, "--env.dataset.frames=starts.npz"], "starts.npz: under a budget"),
        (train, [*IMAGINED, STARTS, *REAL, "--selection.freq=1"], "--selection.freq=1: under a budget"),
        (
            train_world_model,
            [*TOKENIZER, "--dataset.more=[{out}]"],
            "--dataset.more={out}: no LeRobotDataset",
        ),
        (
            train,
            [*IMAGINED, STARTS, "--gate.dataset.root={out}"],
            "--gate.dataset.root={out}: no LeRobotDataset",
        ),
        (
            train,
            [*IMAGINED, STARTS, UNCHECKED, "--dyna.rounds=1", "--dyna.dataset.roots=[{out}]"],
            "--dyna.dataset.roots={out}: no LeRobotDataset",
        ),
        (train, [*SIMULATED, "--selection.freq=1"], "leave out --real_env.type, or --selection.freq"),
        (train, [*SIMULATED, "--iterations=3"], "6 more rollouts are wanted, 5 of 5 are left"),
        (train, [*SIMULATED, "--budget={out}/none.json"], "none.json: there is no such file; write it: "),
    ],
)
def test_what_the_budget_does_not_know_is_refused(
    command: Callable[[], None],
    flags: list[str],
    message: str,
    run: Any,
    paths: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = paths["budget"].read_text()
    with pytest.raises(SystemExit) as stopped:
        run(command, "--budget={budget}", *flags)
    assert stopped.value.code == 1
    assert message.format(**paths) in capsys.readouterr().err
    assert paths["budget"].read_text() == before
    assert not (paths["out"] / "checkpoints").exists()


def test_what_the_budget_knows_is_learnt_from(run: Any, paths: dict[str, Any]) -> None:
    """A part of a dataset is enough where no more is chosen."""
    content = json.loads(paths["budget"].read_text())
    del content["episodes"][[*content["episodes"]][-1]]
    paths["budget"].write_text(json.dumps(content))
    out = run(train_world_model, "--budget={budget}", *TOKENIZER, "--dataset.episodes=[0,1]")
    assert (out / "checkpoints" / "last").exists()
    shutil.rmtree(out)
    starts = ["--env.dataset.root={data}", "--env.dataset.episodes=[0,1]", UNCHECKED]
    assert (run(train, "--budget={budget}", *IMAGINED, *starts) / "checkpoints" / "last").exists()


def test_training_in_the_simulator_is_charged_as_rollouts(run: Any, paths: dict[str, Any]) -> None:
    """Two iterations of two environments of four steps, which is the longest episode, once."""
    for _ in range(2):
        run(train, "--budget={budget}", *SIMULATED)
    assert Ledger(paths["budget"]).read().trainings == {"out": 4}


@pytest.mark.parametrize("steps", [6, 8])
def test_steps_are_counted_as_the_longest_episodes(steps: int, run: Any, paths: dict[str, Any]) -> None:
    run(train, "--budget={budget}", *SIMULATED, "--iterations=1", f"--rollout_steps={steps}")
    assert Ledger(paths["budget"]).read().trainings == {"out": {6: 3, 8: 4}[steps]}


def test_what_a_training_records_is_charged_by_the_commands_that_it_runs(
    run: Any, monkeypatch: pytest.MonkeyPatch, paths: dict[str, Any], small_dataset: LeRobotDataset
) -> None:
    commands: list[list[str]] = []

    def stop(command: list[str]) -> None:
        commands.append(command)
        if command[0] == "lerobot-wmrl-train-world-model":
            raise ValueError("enough")

    for module in (dyna, recorders):
        monkeypatch.setattr(module, "run_subcommand", stop)
    with pytest.raises(SystemExit):
        run(train, "--budget={budget}", *IMAGINED, STARTS, *REAL, "--gate.action=off", "--dyna.rounds=1")
    names = [command[0].removeprefix("lerobot-wmrl-") for command in commands]
    assert names == ["record", "record", "train-world-model"]
    assert all(f"--budget={paths['budget']}" in command for command in commands)


@pytest.mark.parametrize(
    ("command", "flags", "message"),
    [
        (
            train_world_model,
            [*TOKENIZER, "--dataset.root={reported}"],
            "--dataset.root={reported}: 2 of 6 episodes to learn from have evaluation seeds or unseen scenes"
            ", the first is episode 2 (seed 1000007, scene 0); choose others with --dataset.episodes",
        ),
        (
            train_world_model,
            [*TOKENIZER, "--dataset.more=[{reported}]"],
            "--dataset.more={reported}: 2 of 6 ep",
        ),
        (
            train,
            [*IMAGINED, UNCHECKED, "--env.dataset.root={reported}", "--env.dataset.scenes=[1,3]"],
            "--env.dataset.root={reported}: 1 of 4 episodes to learn from",
        ),
        (
            train,
            [*IMAGINED, UNCHECKED, "--env.dataset.root={reported}"],
            "choose others with --env.dataset.split=ind or --env.dataset.scenes",
        ),
        (
            train,
            [*IMAGINED, UNCHECKED, "--env.dataset.resets=2", "--env.dataset.split=ood"],
            "--env.dataset.split=ood: results are reported on unseen scenes",
        ),
    ],
)
def test_what_is_reported_on_is_not_learnt_from(
    command: Callable[[], None],
    flags: list[str],
    message: str,
    run: Any,
    paths: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        run(command, *flags)
    assert message.format(**paths) in capsys.readouterr().err
    assert not paths["out"].exists()


def test_the_others_of_such_a_dataset_are_learnt_from_and_all_are_measured(
    run: Any, paths: dict[str, Any], reported: Path
) -> None:
    run(train_world_model, *TOKENIZER, "--dataset.root={reported}", "--dataset.episodes=[0,1,3,5]")
    measured = TrainConfig()
    measured.gate.dataset.root = str(reported)
    check_data(measured, PointConfig())
    measured.selection.dataset.root = str(reported)
    said = r"selection\.dataset\.root=.*: 1 of 6 episodes have evaluation seeds.* \(seed 1000007\)"
    with pytest.raises(FieldError, match=said):
        check_data(measured, PointConfig())
