"""Presets: files that stand for flags, that every command can parse and that LeRobot reads by itself."""

from pathlib import Path

import draccus
import pytest
from draccus.wrappers import docstring
from lerobot.configs.train import TrainPipelineConfig

import lerobot_env_wmrl  # noqa: F401
from lerobot_wmrl.common import presets
from lerobot_wmrl.common.flags import format_flags
from lerobot_wmrl.common.presets import expand_preset, presets_of, read_settings
from lerobot_wmrl.demo.stages import DemoConfig
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig

CONFIGS = {
    "demo": DemoConfig,
    "train-world-model": TrainWorldModelConfig,
    "eval-world-model": EvalWorldModelConfig,
    "train": TrainConfig,
    "sft": TrainPipelineConfig,
}
REQUIRED = {TrainPipelineConfig: ["--dataset.repo_id=local/data"]}
FILES = sorted(presets.FOLDER.glob("*/*.yaml"))


@pytest.fixture(autouse=True)
def quick_parsing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draccus otherwise looks for the help text of every flag in its source."""
    monkeypatch.setattr(docstring, "get_attribute_docstring", lambda *_: docstring.AttributeDocString())


@pytest.fixture
def small_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        "tiny/train.yaml": "{steps: 4, save: true}",
        "tiny/train.a.yaml": "{model: {type: a}, steps: 8}",
        "demo/train.b.yaml": "{x: {y: 0.5}}",
        "cpu/rl.yaml": "{a: {type: ppo, clip: 0.2, codes: [8, 5]}, steps: 3}",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(presets, "FOLDER", tmp_path)


@pytest.mark.usefixtures("small_folder")
def test_flags_stand_where_the_preset_stood() -> None:
    """So what the user types further right wins, and what is further left is overridden."""
    argv = ["--seed=1", "--preset=tiny", "--steps=9"]
    assert expand_preset(argv, "train") == ["--seed=1", "--steps=4", "--save=true", "--steps=9"]


@pytest.mark.usefixtures("small_folder")
def test_the_file_of_the_chosen_type_is_read() -> None:
    argv = ["--preset=tiny", "--model.type=a"]
    assert expand_preset(argv, "train") == ["--model.type=a", "--steps=8", "--model.type=a"]
    assert expand_preset(["--preset=demo", "--model.type=b"], "train") == ["--x.y=0.5", "--model.type=b"]
    assert presets_of("train") == {"tiny": ["a"], "demo": ["b"]}


@pytest.mark.usefixtures("small_folder")
def test_another_type_takes_the_preset_s_settings_of_it_along() -> None:
    ppo = ["--a.type=ppo", "--a.clip=0.2", "--a.codes=[8,5]"]
    assert expand_preset(["--preset=cpu"], "rl") == [*ppo, "--steps=3"]
    assert expand_preset(["--preset=cpu", "--a.type=grpo"], "rl") == ["--steps=3", "--a.type=grpo"]
    assert expand_preset(["--preset=cpu", "--a.type=ppo"], "rl") == [*ppo, "--steps=3", "--a.type=ppo"]


@pytest.mark.usefixtures("small_folder")
@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--preset=huge"], "--preset=huge: unknown preset; choose one of tiny, demo, cpu"),
        (["--preset=demo", "--x.type=c"], "--preset=demo: train has no such preset; it has: tiny"),
        (["--preset=demo"], "--preset=demo: train has one a type; give a type: b"),
    ],
)
def test_unknown_presets_are_named(argv: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        expand_preset(argv, "train")


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
@pytest.mark.parametrize("as_flags", [False, True], ids=["config_path", "preset"])
def test_every_file_is_a_configuration_of_its_command(path: Path, as_flags: bool) -> None:
    """Both as LeRobot's `--config_path` reads it and as the flags that `--preset` stands for."""
    config_class: type = CONFIGS[path.name.split(".")[0]]
    required = REQUIRED.get(config_class, [])
    settings = read_settings(path)
    if as_flags:
        config = draccus.parse(config_class, args=[*format_flags(settings), *required])
    elif config_class is TrainPipelineConfig:
        config = TrainPipelineConfig.from_pretrained(path, cli_args=required)
    else:
        config = draccus.parse(config_class, config_path=path, args=required)
    stored = read_settings_of(config)
    assert {name: stored[name] for name in settings} == settings


def read_settings_of(config: object) -> dict[str, object]:
    return dict(presets._flat(draccus.encode(config), ()))


def test_the_demos_defaults_are_those_of_its_preset() -> None:
    """`--preset=demo` and no preset are the same."""
    assert DemoConfig(**presets.preset_settings("demo", "demo")) == DemoConfig()
