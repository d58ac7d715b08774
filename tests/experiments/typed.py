"""Parse commands as a user types them, without running them."""

import re
import shlex
import sys
import tomllib
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import draccus
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.parser import PLUGIN_DISCOVERY_SUFFIX, filter_arg, load_plugin, parse_plugin_args
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_edit_dataset import EditDatasetConfig
from lerobot.scripts.lerobot_record import RecordConfig
from lerobot.scripts.lerobot_replay import ReplayConfig
from lerobot.scripts.lerobot_rollout import RolloutConfig
from lerobot.scripts.lerobot_teleoperate import TeleoperateConfig
from lerobot.utils.import_utils import register_third_party_plugins

import lerobot_env_wmrl  # noqa: F401 (registers what LeRobot is to know)
from lerobot_wmrl.common import stages
from lerobot_wmrl.common.command_line import parse_flags
from lerobot_wmrl.common.quick_parsing import parsed_quickly
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import EmbeddingConfig

ROOT = Path(__file__).parents[2]
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
LEROBOT: dict[str, type[Any]] = {
    "lerobot-train": TrainPipelineConfig,
    "lerobot-eval": EvalPipelineConfig,
    "lerobot-edit-dataset": EditDatasetConfig,
    "lerobot-record": RecordConfig,
    "lerobot-replay": ReplayConfig,
    "lerobot-rollout": RolloutConfig,
    "lerobot-teleoperate": TeleoperateConfig,
}
SHELL = {"cp", "ln", "source", "pip", "make", "hf", "apt", ".uv/bin/uv"}

PATH = re.compile(r"[^,\[\]]*/[^,\[\]]*")
NUMBER = re.compile(r"(?<![\w.])-?\d+(\.\d+)?(e-?\d+)?(?![\w.])")

PARSED: set[tuple[str, ...]] = set()
"""Commands that programs take, as `without_numbers` makes them."""

registered = cache(register_third_party_plugins)


class Stopped(BaseException):
    """A command has said how it parses its flags."""


def words_of(command: str) -> list[str]:
    """Split a command, the last one of a list. What the shell would insert is the number 0 here."""
    inserted = re.sub(r"\$\(\(.*?\)\)|\$\([^)]*\)|\$episodes", "0", command)
    words = shlex.split(inserted.rpartition("&&")[2])
    set_by_env = next(at for at, word in enumerate(words) if word != "env" and "=" not in word)
    return words[set_by_env:]


def check(command: str) -> None:
    """Raise an error if the program of a command would not take its flags.

    Checkpoints need not be there: nothing looks into its world model here. Parsing takes long: of commands
    that differ in numbers and paths alone, one is parsed.
    """
    words = words_of(command)
    if (kind := tuple(map(without_numbers, words))) not in PARSED:
        parse(words)
        PARSED.add(kind)


def without_numbers(word: str) -> str:
    """Return a word with all paths in a flag's value, all its whole numbers and all others made the same."""
    name, equals, value = word.partition("=")
    numbers = NUMBER.sub(lambda found: "0.5" if found[1] or found[2] else "0", PATH.sub("/", value))
    return name + equals + numbers


def parse(words: list[str]) -> None:
    program, *flags = (word for word in words if word != "--help")
    unseen = {"__post_init__": lambda self: None}
    with patch.multiple(WorldModelEnv, **unseen), patch.multiple(EmbeddingConfig, **unseen):
        if program == "torchrun":
            at = flags.index("-m")
            check_ours(flags[at + 1], flags[at + 2 :])
        elif program == "python":
            check_module(flags)
        elif program in SCRIPTS:
            check_ours(SCRIPTS[program].partition(":")[0], flags)
        elif program in LEROBOT:
            registered()
            for name, package in parse_plugin_args(PLUGIN_DISCOVERY_SUFFIX, flags).items():
                load_plugin(package)
                flags = filter_arg(name, flags)
            with parsed_quickly():
                draccus.parse(LEROBOT[program], args=without_paths(flags))
        else:
            assert program in SHELL, f"{program}: not a command that is known here"


def without_paths(flags: list[str]) -> list[str]:
    """Replace what need not be there: a policy's checkpoint by its type, the configuration of a resumed
    training by what it must have. Leave out a file of meshes."""
    own = {"--policy.sampling": "openvla", "--policy.camera": "openvla", "--policy.n_action_steps": "act"}
    kinds = [own[name] for flag in flags if (name := flag.partition("=")[0]) in own]
    kind = f"--policy.type={kinds[0] if kinds else 'cnn'}"
    replaced = {"--policy.path": kind, "--config_path": "--dataset.repo_id=local/any"}
    return [
        replaced.get(flag.partition("=")[0], flag) for flag in flags if not flag.startswith("--env.assets")
    ]


def check_ours(module_name: str, flags: list[str]) -> None:
    """Parse as a console command does, with its own presets, up to the point at which it would begin."""
    module, said = import_module(module_name), {}

    def run_command(function: Any, config_class: type[Any], expand: Any) -> None:
        said.update(config_class=config_class, expand=expand)
        raise Stopped

    with patch.object(sys, "argv", [module_name, *without_paths(flags)]):
        runner = module if hasattr(module, "run_command") else stages  # of commands that are made of stages
        with patch.object(runner, "run_command", run_command), suppress(Stopped):
            module.main()
        sys.argv[1:] = said["expand"](sys.argv[1:])
        parse_flags(said["config_class"])


def check_module(arguments: list[str]) -> None:
    """`python -m experiments.NAME …` and `python benchmarks/NAME.py …` (or examples/): their parsers take the
    flags."""
    if arguments[0] == "-m":
        module_name, flags = arguments[1], arguments[2:]
        if not module_name.startswith("experiments"):
            return
    else:
        sys.path.insert(0, str((ROOT / arguments[0]).parent))
        module_name, flags = Path(arguments[0]).stem, arguments[1:]
    try:
        import_module(module_name).make_parser().parse_known_args(flags)
    except SystemExit as stopped:
        raise AssertionError(f"{module_name} does not take {flags}") from stopped
