"""Every command answers bad input with one line, an exit code that is not 0, and untouched folders."""

import logging
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_dataset_maniskill.record import main as record
from lerobot_wmrl.maniskill import backend
from lerobot_wmrl.scripts.compare import main as compare
from lerobot_wmrl.scripts.convert_openvla import main as convert_openvla
from lerobot_wmrl.scripts.demo import main as demo
from lerobot_wmrl.scripts.eval_world_model import main as eval_world_model
from lerobot_wmrl.scripts.judge import main as judge
from lerobot_wmrl.scripts.play import main as play
from lerobot_wmrl.scripts.train import main as train
from lerobot_wmrl.scripts.train_world_model import main as train_world_model
from tests.rl.checkpoints import save_untrained_policy

Command = Callable[[], None]
REPLAY = ["--model.path={action_world_model}", "--dataset.root={data}"]
SIMULATOR = ["--env.type=wmrl_maniskill"]
TRAIN = ["--dataset.root={data}", "--model.type=frame_tokenizer", "--model.tokenizer.image_size=32"]
TWO = "--policies=[{policy},{other}]"
FITTING = ["--policies=[{cnn},{copy}]", *SIMULATOR]
JUDGED = ["--world_model.path={action_world_model}", "--dataset.root={data}"]
NEW = "--target={foreign}/new"
REAL = ["--real_env.type=wmrl_maniskill", "--real_env.image_size=32"]
IMPORT = ["--direction=import", "--source={policy}"]
ROLL_OUT = ["--policy.path={policy}", *SIMULATOR, "--num_episodes=1"]


@pytest.mark.parametrize(
    ("command", "flags", "message"),
    [
        (
            record,
            ["--env.type=wmrl_maniskill", "--env.batched=true", "--output_dir=out"],
            "--env.batched=true: a recording has",
        ),
        (record, [*SIMULATOR, "--env.task=juggle"], "--env.task=juggle: unknown; choose one of push"),
        (record, ["--preset=huge"], "--preset=huge: unknown preset; choose one of cpu, demo"),
        (
            record,
            ["--output_dir=out", "--max_frames=9"],
            "--max_frames=9: wmrl_maniskill has a setting of its own; set --env.episode_length",
        ),
        (
            record,
            ["--push_to_hub=true"],
            "called local/new; give its name on the hub, user/name, as --repo_id",
        ),
        (record, ["--output_dir={foreign}"], "foreign: holds something else"),
        (record, ROLL_OUT, "observation.images.third_view of shape (3, 32, 32), the environment has"),
        (record, ["--policy.path={action_world_model}"], "no policy can be loaded from it"),
        (record, ["--policy.path={foreign}"], "config.json is missing"),
        (train, ["--policy.path={foreign}", *SIMULATOR], "config.json is missing"),
        (train, [*SIMULATOR, "--preset=huge"], "--preset=huge: unknown preset"),
        (train_world_model, ["--dataset.root={foreign}"], "no LeRobotDataset there"),
        (
            train_world_model,
            ["--dataset.root={data}", "--preset=demo"],
            "give a type: action_world_model, frame",
        ),
        (train_world_model, [*TRAIN, "--output_dir={foreign}"], "foreign: holds something else"),
        (train_world_model, [*TRAIN, "--output_dir={foreign}/thesis.txt"], "txt: is a file"),
        (eval_world_model, [*REPLAY, "--output_dir={foreign}"], "foreign: holds something else"),
        (eval_world_model, ["--model.path={frame_tokenizer}", "--dataset.root={data}"], "action_world_model"),
        (eval_world_model, [*REPLAY, "--max_episodes=0"], "--max_episodes=0: must be at least 1"),
        (
            eval_world_model,
            [*REPLAY, "--policies=[{foreign}]", "--policy_episodes=1", *REAL],
            "foreign: no checkpoint there",
        ),
        (
            play,
            ["--world_model.path={foreign}", "--dataset.root={data}"],
            "foreign: no action_world_model there",
        ),
        (play, ["--world_model.path={foreign}", "--dataset.root={data}"], "--world_model.path="),
        (compare, ["--policies=[{policy}]", *SIMULATOR], "policy]: a comparison needs at least two"),
        (compare, ["--policies=[{cnn},{cnn}]", *SIMULATOR], "cnn: is given twice; give every"),
        (compare, ["--policies=[{cnn},{foreign}]", *SIMULATOR], "foreign: no checkpoint there"),
        (compare, ["--policies=[{cnn},{action_world_model}]", *SIMULATOR], "no policy can be loaded from it"),
        (compare, [TWO], "--env.type: is missing: policies are compared in an environment"),
        (compare, [TWO, *SIMULATOR], "third_view of shape (3, 32, 32), the environment has"),
        (compare, [TWO, *SIMULATOR, "--env.image_size=32"], "has 3 action components, the environment 7"),
        (compare, [TWO, *SIMULATOR, "--against=none"], "--against=none: choose one of first, all"),
        (judge, JUDGED, "--policies=[]: there is nothing to judge"),
        (
            judge,
            ["--policies=[{cnn}]"],
            "--world_model.path: is missing; give the output folder of its training",
        ),
        (judge, ["--policies=[{cnn}]", *JUDGED[:1]], "--dataset.root: is missing: labelled rollouts say"),
        (
            judge,
            ["--policies=[{cnn}]", *JUDGED, "--starts.split=train"],
            "--starts.root: is missing, so that",
        ),
        (judge, ["--policies=[{foreign}]", *JUDGED], "foreign: no checkpoint there"),
        (
            judge,
            ["--policies=[{cnn}]", *JUDGED, "--references={foreign}/thesis.txt"],
            "no success of policies",
        ),
        (compare, [TWO, *SIMULATOR, "--n_episodes=0"], "--n_episodes=0: must be at least 1"),
        (compare, [TWO, *SIMULATOR, "--n_episodes=3"], "--batch_size=4: there are 3 episodes; lower it"),
        (compare, [TWO, *SIMULATOR, "--alpha=1"], "--alpha=1.0: must be above 0 and below 1"),
        (compare, [*FITTING, "--output_dir={foreign}"], "foreign: holds something else"),
        (convert_openvla, ["--direction=sideways", NEW], "--direction=sideways: choose one of import"),
        (convert_openvla, ["--direction=import", NEW], "--source: give the checkpoint to convert"),
        (
            convert_openvla,
            [*IMPORT, "--target={foreign}"],
            "foreign: there is something already; choose a new",
        ),
        (convert_openvla, [*IMPORT, NEW], "policy: tokenizer.json is missing beside"),
        (convert_openvla, ["--direction=export", "--source={policy}", NEW], "of type cnn"),
        (demo, ["--preset=huge"], "--preset=huge: unknown preset"),
        (demo, ["--size=huge"], "--size=huge: choose one of tiny, demo"),
        (demo, ["--output_dir={foreign}"], "foreign: holds something else"),
        (demo, ["--sead=1"], "--sead"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(
    command: Command,
    flags: list[str],
    message: str,
    trained_models: dict[str, Path],
    small_dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("precious")
    paths = {
        "policy": save_untrained_policy(tmp_path / "policy"),
        "other": save_untrained_policy(tmp_path / "other"),
        "cnn": save_untrained_policy(tmp_path / "cnn", size=128, actions=7),
        "copy": save_untrained_policy(tmp_path / "copy", size=128, actions=7),
        "foreign": foreign,
        "data": small_dataset.root,
    }
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    given = [flag.format(**paths, **trained_models) for flag in flags]
    if not any(flag.startswith(("--output_dir", "--target")) for flag in given):
        given.append(f"--output_dir={tmp_path / 'new'}")
    assert message in error_of(command, given, monkeypatch, capfd)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_without_a_renderer_nothing_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import sapien

    def no_device(name: str) -> None:
        raise RuntimeError(f"{name}: none here")

    monkeypatch.setattr(sapien, "Device", no_device)
    monkeypatch.setattr(sapien.render, "get_device_summary", lambda: "")
    assert backend.NO_RENDERER in error_of(record, [f"--output_dir={tmp_path / 'new'}"], monkeypatch, capfd)
    assert not list(tmp_path.iterdir())


def error_of(
    command: Command, flags: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> str:
    """What the command says as it stops."""
    monkeypatch.setattr(sys, "argv", ["command", *flags])
    monkeypatch.setattr(logging, "raiseExceptions", False)  # handlers of earlier tests, their streams closed
    with pytest.raises(SystemExit) as stopped:
        command()
    said = capfd.readouterr().err
    if isinstance(stopped.value.code, str):  # Python prints it, and exits with 1
        said += stopped.value.code
    else:
        assert stopped.value.code in (1, 2), said  # argparse exits with 2
    assert "Traceback" not in said
    return said
