"""Fields become the flags that were typed, and flags that do not exist lead to those that do."""

import importlib
import pkgutil
import sys
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import draccus
import pytest
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.rewards import RewardModelConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.robots import RobotConfig

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl import scripts
from lerobot_wmrl.common.command_errors import near_flag, said_in_flags
from lerobot_wmrl.common.command_line import (
    GivenPath,
    RunConfig,
    parse_flags,
    run_command,
    with_default_types,
    with_equals_signs,
    with_home,
    with_texts_as_typed,
)
from lerobot_wmrl.common.errors import FieldError, Stopped
from lerobot_wmrl.common.output_folders import different_settings
from lerobot_wmrl.common.settings import settings_of
from lerobot_wmrl.rl.configuration_train import TrainConfig


@dataclass
class Reward:
    form: str = "potential"
    gamma: float = 0.97


@dataclass
class Env:
    reward: Reward = field(default_factory=Reward)
    length: int = 40


@dataclass
class Config(RunConfig):
    """Args:
    env: where the policy acts.
    real: where success is measured.
    """

    env: Env = field(default_factory=Env)
    real: Env = field(default_factory=lambda: Env(length=60))
    iterations: int = 3


@dataclass
class Texts(RunConfig):
    """Settings that are texts, and one that is not."""

    folder: Path = Path()
    text: str = ""
    optional: str | None = None
    texts: list[str] = field(default_factory=list)
    number: int = 0


@pytest.mark.parametrize(
    ("error", "typed", "message"),
    [
        (
            FieldError("reward.form", "odd", "unknown", "choose one of those of `length`"),
            ["--real.reward.form=odd"],
            "--real.reward.form=odd: unknown; choose one of those of --real.length",
        ),
        (
            FieldError("gamma", 2, "too large", "lower it, or set `form=absolute`"),
            ["--env.reward.gamma=2", "--real.reward.gamma=0.5"],
            "--env.reward.gamma=2: too large; lower it, or set --env.reward.form=absolute",
        ),
        (FieldError("length", 60, "too long"), [], "--real.length=60: too long"),
        (FieldError("iterations", "", "is missing"), [], "--iterations: is missing"),
        (FieldError("width", 7, "odd", "see `config.json`"), [], "width=7: odd; see `config.json`"),
        (ValueError("no `length`"), [], "no `length`"),
        (Stopped("lower `reward.gamma`"), ["--real.reward.gamma=1"], "lower --real.reward.gamma"),
        (Stopped("give fewer `iterations=2`"), [], "give fewer --iterations=2"),
    ],
)
def test_a_field_is_said_as_its_flag(error: ValueError, typed: list[str], message: str) -> None:
    assert said_in_flags(error, Config, typed) == message


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("steps", "iterations"),
        ("iteration", "iterations"),
        ("sead", "seed"),
        ("env.episode_lenght", "env.episode_length"),
        ("policy.alpha", "env.reward.alpha"),
        ("frobnicate", None),
    ],
)
def test_a_flag_that_does_not_exist_leads_to_one_that_does(name: str, near: str | None) -> None:
    assert (
        near_flag(name, list(settings_of(TrainConfig, {"env": "world_model"})), TrainConfig.other_names)
        == near
    )


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--steps=3"], "there is no flag --steps: did you mean --iterations?"),
        (
            ["--env.type=world_model", "--real_env.episode_length=9"],
            "--real_env.episode_length is a setting of a type: give --real_env.type=…",
        ),
        (
            ["--env.type=world_model", "--env.robot_mesh_detail=1"],
            "there is no flag --env.robot_mesh_detail: see --help",
        ),
        (
            ["--env.type=world_model", "--env.max_starts=3"],
            "there is no flag --env.max_starts: did you mean --env.dataset.max_starts?",
        ),
        (
            ["--env.type=world_model", "--env.reward.type=general", "--env.reward.alpha=x"],
            "--env.reward.alpha: Couldn't parse 'x' into a float",
        ),
        (
            ["--env.type=world_model", "--env.episode_length=x"],
            "--env.episode_length: Couldn't parse 'x' into an int",
        ),
        (["--iterations=many"], "--iterations: Couldn't parse 'many' into an int"),
    ],
)
def test_what_cannot_be_parsed_is_said_in_one_line(
    flags: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["lerobot-wmrl-train", *flags])
    with pytest.raises(ValueError) as error:  # noqa: PT011  (the whole message is compared)
        parse_flags(TrainConfig)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("command", "flags", "added"),
    [
        (RecordConfig, ["--env.image_size=33"], ["--env.type=wmrl_maniskill"]),
        (TrainConfig, ["--algorithm.policy_lr=1e-4"], ["--algorithm.type=ppo"]),
        (TrainConfig, ["--env.type=world_model", "--env.reward.alpha=1"], ["--env.reward.type=general"]),
        (TrainConfig, ["--env.type=world_model", "--env.reward.type=embedding", "--env.reward.alpha=1"], []),
        (TrainConfig, ["--real_env.episode_length=9", "--policy.path=x", "--policy.device=cpu"], []),
        (TrainConfig, ["--config_path=user/policy", "--algorithm.policy_lr=1e-4"], []),
    ],
)
def test_a_default_type_need_not_be_typed(
    command: type[RunConfig], flags: list[str], added: list[str]
) -> None:
    assert with_default_types(flags, command) == [*flags, *added]


def test_what_is_said_of_a_checkpoint_is_noted_where_flags_are_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A configuration that is made in Python knows nothing of the process's flags."""
    monkeypatch.setattr(parser, "_config_path_args", {})
    monkeypatch.setattr(parser, "_config_yaml_overrides", {})
    file = tmp_path / "settings.yaml"
    file.write_text("policy: {path: stored, n_obs_steps: 1, names: [a, b]}")
    flags = [f"--config_path={file}", "--policy.path=outputs/a", "--policy.device=cpu", "--seed=3"]
    monkeypatch.setattr("sys.argv", ["lerobot-wmrl-train", *flags])
    config = parse_flags(TrainConfig)
    assert TrainConfig().given == {"policy": GivenPath(None, [])}
    monkeypatch.setattr("sys.argv", ["another"])
    settings = ["--n_obs_steps=1", '--names=["a", "b"]', "--device=cpu"]
    assert config.given == {"policy": GivenPath("outputs/a", settings)}


def test_flags_may_be_written_with_a_space() -> None:
    argv = ["--preset", "tiny", "--resume", "--a.b=1", "--c", "-1", "--help", "-h", "--d=x y"]
    assert with_equals_signs(argv) == [
        "--preset=tiny",
        "--resume",
        "--a.b=1",
        "--c=-1",
        "--help",
        "-h",
        "--d=x y",
    ]


def test_the_home_folder_is_expanded_in_flags() -> None:
    home = str(Path.home())
    assert with_home(["--a=~/x", "--b=~", "--c=x/~/y", "--resume"]) == [
        f"--a={home}/x",
        "--b=~",
        "--c=x/~/y",
        "--resume",
    ]


def test_ctrl_c_ends_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(config: RunConfig) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sys.argv", ["command"])
    with pytest.raises(SystemExit, match="run the same command again; it continues"):
        run_command(interrupted, RunConfig, list)


def test_a_setting_that_another_version_lacks_is_off_there():
    """So a run that began before an option existed goes on, unless the option is used."""
    stored = {"seed": 1, "env": {"length": 40, "gone": 0}}
    assert different_settings(stored, {"seed": 1, "env": {"length": 40, "new": None}}, ()) == []
    assert different_settings(stored, {"seed": 2, "env": {"length": 40, "new": 3}}, ["seed"]) == [
        "env.new None → 3"
    ]
    assert different_settings({"real": None}, {"real": {"type": "pusht"}}, ()) == ["real.type None → 'pusht'"]


@pytest.mark.parametrize(
    "typed",
    [
        "2024-01-15",
        "2024_01_15",
        "0123",
        "1.10",
        "1e3",
        "a #b",
        "#3 run",
        "#",
        "yes",
        "a: b",
        "plain",
        "push,pull",
        "[a",
        "12:30",
    ],
)
def test_texts_stay_as_they_are_typed(typed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """YAML makes dates, numbers and truth values of them."""
    flags = [f"--{name}={typed}" for name in ("folder", "text", "optional")]
    listed = [] if {*typed} & {*",#:["} else [f"--texts=[{typed},b]"]
    monkeypatch.setattr(sys, "argv", ["command", *with_texts_as_typed([*flags, *listed], Texts)])
    read = parse_flags(Texts)
    assert (read.folder, read.text, read.optional) == (Path(typed), typed, typed)
    assert read.texts == ([typed, "b"] if listed else [])


def test_what_is_quoted_or_empty_or_no_text_is_left_alone() -> None:
    given = [
        '--text="a"',
        "--text='1'",
        "--optional=null",
        "--text=",
        "--number=3",
        "--texts=[a,b]",
        "--flag",
    ]
    assert with_texts_as_typed(given, Texts) == given


def every_config() -> list[type]:
    """The configuration of every command, policy, reward model, environment, algorithm and robot of ours."""
    for _, name, _ in pkgutil.iter_modules(scripts.__path__, f"{scripts.__name__}."):
        importlib.import_module(name)
    importlib.import_module("lerobot_dataset_maniskill.record")
    importlib.import_module("lerobot_robot_imagined.config_imagined")
    bases = PreTrainedConfig, RewardModelConfig, EnvConfig, RLAlgorithmConfig, RobotConfig
    known = [each for base in bases for each in base.get_known_choices().values()]
    ours = "lerobot_wmrl", "lerobot_policy", "lerobot_robot", "lerobot_dataset"
    return [each for each in (*RunConfig.__subclasses__(), *known) if each.__module__.startswith(ours)]


def nested(config_class: type, seen: set[type]) -> Iterator[tuple[str, type, Any]]:
    """Yield the settings that are settings themselves: their names, declared types and defaults."""
    hints = get_type_hints(config_class)
    for each in fields(config_class):
        declared = hints[each.name]
        if not is_dataclass(declared) or declared in seen or draccus.utils.is_choice_type(declared):
            continue
        if each.default_factory is not MISSING:
            yield f"{config_class.__name__}.{each.name}", declared, each.default_factory()
        yield from nested(declared, seen | {declared})


def test_a_setting_that_is_given_changes_no_other_one() -> None:
    """Where one setting of several is given, draccus takes the others from the class, not from what the field
    makes by default."""
    found = [each for config in every_config() if is_dataclass(config) for each in nested(config, set())]
    assert {"Sizes.dino", "DistillationConfig.planner", "ImaginedRobotConfig.dataset"} <= {
        name for name, *_ in found
    }
    assert [name for name, declared, default in found if default != declared()] == []
