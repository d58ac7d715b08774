"""`--help` of every command: what it is for, examples, presets, and every flag with its default."""

import json
import subprocess
import sys

import pytest

from lerobot_dataset_maniskill import record
from lerobot_wmrl.common.command_line import help_of
from lerobot_wmrl.common.settings import settings_of
from lerobot_wmrl.common.stored_help import FOLDER
from lerobot_wmrl.scripts import (
    compare,
    convert_openvla,
    demo,
    eval_world_model,
    improve,
    judge,
    label,
    play,
    resample,
    train,
    train_world_model,
)

COMMANDS = {
    "lerobot-wmrl-record": (record.run, record.RecordConfig),
    "lerobot-wmrl-demo": (demo.run_demo, demo.DemoConfig),
    "lerobot-wmrl-eval-world-model": (
        eval_world_model.eval_world_model,
        eval_world_model.EvalWorldModelConfig,
    ),
    "lerobot-wmrl-train": (train.train_policy, train.TrainConfig),
    "lerobot-wmrl-train-world-model": (
        train_world_model.train_world_model,
        train_world_model.TrainWorldModelConfig,
    ),
    "lerobot-wmrl-improve": (improve.improve, improve.ImproveConfig),
    "lerobot-wmrl-play": (play.play, play.PlayConfig),
    "lerobot-wmrl-compare": (compare.compare, compare.CompareConfig),
    "lerobot-wmrl-judge": (judge.judge, judge.JudgeConfig),
    "lerobot-wmrl-label": (label.label, label.LabelConfig),
    "lerobot-wmrl-resample": (resample.resample, resample.ResampleConfig),
    "lerobot-wmrl-convert-openvla": (convert_openvla.convert, convert_openvla.ConvertOpenVLAConfig),
}


WITHOUT_PRESET = ("compare", "improve", "judge", "label", "openvla", "play", "resample")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_and_shows_no_source_code(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", [command, "--help"])
    function, config_class = COMMANDS[command]
    text = help_of(function, config_class)
    assert text.startswith(f"{command}: ")
    assert f"    {command} --" in text  # an example
    assert "--preset=" in text or command.endswith(WITHOUT_PRESET)
    assert "def " not in text
    assert "default_factory" not in text
    settings = list(settings_of(config_class))
    assert text.count("(default:") + text.count("(required)") >= len(settings)
    own = [each for each in settings if each.depth == 0]
    assert not [each.name for each in own if not each.explanation]


def live_pages() -> dict[str, str]:
    """Return what every command says now."""
    pages, typed = {}, sys.argv
    for command, (function, config_class) in COMMANDS.items():
        sys.argv = [command, "--help"]
        pages[command] = help_of(function, config_class)
    sys.argv = typed
    return pages


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """`live_pages` of a process of its own: other tests register types that no user has."""
    result = subprocess.run([sys.executable, __file__], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.parametrize("command", COMMANDS)
def test_the_stored_page_is_what_the_command_says(command: str, pages: dict[str, str]) -> None:
    """Where it is not, `make help` writes it anew."""
    assert (FOLDER / f"{command}.txt").read_text() == f"{pages[command]}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_neither_torch_nor_lerobot(command: str) -> None:
    program = (
        "import atexit, sys; atexit.register(lambda: print({'torch', 'lerobot'} & {*sys.modules}));"
        f"sys.argv = ['{command}', '--help']; import {COMMANDS[command][0].__module__}"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.stdout == (FOLDER / f"{command}.txt").read_text() + "set()\n"


def test_a_groups_explanation_stands_before_its_first_flag() -> None:
    page = (FOLDER / "lerobot-wmrl-train.txt").read_text()
    _, _, after = page.partition("--gate.dataset.root")
    assert "labelled rollouts" in after.partition("  --")[0]


def test_flags_of_a_chosen_type_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["lerobot-wmrl-train", "--env.type=wmrl_maniskill", "--help"])
    text = help_of(train.train_policy, train.TrainConfig)
    assert "--env.robot_mesh_detail" in text
    assert "--env.world_model_path  " not in text


if __name__ == "__main__":
    print(json.dumps(live_pages()))
