"""What every console command shares: parsing, help, errors without tracebacks."""

import inspect
import json
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import cache, cached_property
from io import StringIO
from pathlib import Path
from typing import ClassVar, NamedTuple

import draccus
import yaml
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_wmrl.common.command_errors import cause, parsing_error, said_in_flags, untyped
from lerobot_wmrl.common.errors import STOPPED, FieldError, Stopped
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.flags import TYPE, format_flags, format_value
from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE
from lerobot_wmrl.common.presets import chosen_types, read_settings, typed_flags
from lerobot_wmrl.common.quick_parsing import parsed_quickly
from lerobot_wmrl.common.settings import help_page, settings_of

MAPPINGS = "input_features", "output_features", "normalization_mapping", "norm_stats"
"""Settings of LeRobot's policies and reward models whose value is a mapping."""

TEXTS = "str", "path", "Path"
"""Kinds of settings that are texts."""

QUOTATION_MARKS = "\"'"


class GivenPath(NamedTuple):
    """What the command line says of a field that is loaded from a checkpoint.

    Args:
        path: `--<field>.path`; None if that is not there.
        settings: settings beside it, as flags of the checkpoint's own configuration: `--n_action_steps=8`.
    """

    path: str | None
    settings: list[str]


@dataclass
class RunConfig:
    """Base of the commands' configurations: parsed by draccus, saved beside what the run makes."""

    path_fields: ClassVar[list[str]] = []

    other_names: ClassVar[dict[str, str]] = {}
    """Names that LeRobot's own commands have for some of the flags (`{"steps": "iterations"}`)."""

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Return the fields that are loaded from a checkpoint given as `--<field>.path`."""
        return cls.path_fields

    @cached_property
    def given(self) -> dict[str, GivenPath]:
        """What the command line says of each of `path_fields`: nothing, unless `parse_flags` noted it."""
        return {name: GivenPath(None, []) for name in self.path_fields}

    @cached_property
    def typed_preset(self) -> list[str]:
        """`--preset=NAME` as it was typed, for the commands that are suggested; empty without."""
        return []

    def save_pretrained(self, folder: Path) -> None:
        """Write the configuration as LeRobot does, `train_config.json`."""
        write_json(folder / RUN_CONFIG_FILE, draccus.encode(self))


def given_path(path_field: str) -> GivenPath:
    """Read from the command line `--<field>.path` and the settings beside it, those in a `--config_path` file
    first. LeRobot's own reading of the file leaves out lists and nulls."""
    file, inside = parser.parse_arg("config_path"), f"{path_field}."
    read = read_settings(Path(file), [inside + name for name in MAPPINGS]) if is_file(file) else {}
    settings = {name.removeprefix(inside): value for name, value in read.items() if name.startswith(inside)}
    beside = {  # draccus reads a list of texts or null only as JSON
        name: json.dumps(value) if isinstance(value, list) else value
        for name, value in settings.items()
        if name not in ("path", "type")
    }
    stored = format_flags(beside) if "path" in settings else []
    typed = parser.get_cli_overrides(path_field) or []
    return GivenPath(parser.get_path_arg(path_field), [*stored, *typed])


def is_file(path: str | None) -> bool:
    """Return whether a file is there; LeRobot also takes folders and hub ids."""
    return path is not None and Path(path).is_file()


@cache
def register_plugins() -> None:
    """Register every installed plugin of LeRobot, once."""
    register_third_party_plugins()


def run_command[Config: RunConfig](
    function: Callable[[Config], None],
    config_class: type[Config],
    expand: Callable[[Sequence[str]], list[str]],
) -> None:
    """Parse the command line for `function` and run it. Bad input ends in one clear line and exit code 1, a
    command that stops by a rule of its own in one and STOPPED.

    Args:
        function: what the command does; the docstring of its module introduces `--help`.
        config_class: class of its settings.
        expand: replaces the flags that stand for others (`--preset`).
    """
    register_plugins()
    init_logging()
    logging.getLogger("lerobot.configs").setLevel(logging.ERROR)
    try:
        typed = with_home(with_equals_signs(sys.argv[1:]))
        sys.argv[1:] = with_texts_as_typed(with_default_types(expand(typed), config_class), config_class)
        if {"--help", "-h"} & set(sys.argv[1:]):
            print(help_of(function, config_class))
            return
        config = parse_flags(config_class)
        config.typed_preset.extend(argument for argument in typed if argument.startswith("--preset="))
        function(config)
    except (ValueError, OSError, ParsingError) as error:
        kind, status = ("stopped", STOPPED) if isinstance(error, Stopped) else ("error", 1)
        print(f"{kind}: {said_in_flags(cause(error), config_class, sys.argv[1:])}", file=sys.stderr)
        sys.exit(status)
    except KeyboardInterrupt:
        sys.exit("\nstopped: run the same command again; it continues where it can, and else begins again")


def with_home(argv: Sequence[str]) -> list[str]:
    """Write `--name=~/folder` with the home folder's path, as a shell does only for a word of its own."""
    parts = (argument.partition("=") for argument in argv)
    return [
        f"{name}={Path(value).expanduser()}" if value.startswith("~/") else f"{name}{equals}{value}"
        for name, equals, value in parts
    ]


def with_equals_signs(argv: Sequence[str]) -> list[str]:
    """Write `--name value` as `--name=value`, as presets and LeRobot's `--policy.path` are read."""
    written: list[str] = []
    for argument in argv:
        if written and not argument.startswith("--") and argument != "-h" and is_name(written[-1]):
            written[-1] += f"={argument}"
        else:
            written.append(argument)
    return written


def with_default_types(argv: Sequence[str], config_class: type) -> list[str]:
    """Add `--env.type=<default>`, which draccus asks for, where settings of `env` are typed without its type.

    Not beside a configuration in a folder or on the hub, which says the types itself.
    """
    if (stored := typed_flags(argv).get("config_path")) and not is_file(stored):
        return list(argv)
    settings = settings_of(config_class, chosen_types(argv))
    defaults = {each.name: each.default for each in settings if each.name.endswith(TYPE)}
    return [*argv, *(f"--{kind}={defaults[kind]}" for _, kind in untyped(defaults, argv) if defaults[kind])]


def with_texts_as_typed(argv: Sequence[str], config_class: type) -> list[str]:
    """Write texts that YAML reads as something else, such as `0123`, `1.10` or `2024_01_15`, in quotation
    marks: draccus reads every value as YAML, and makes another text of the number."""
    kinds = {each.name: each.kind for each in settings_of(config_class, chosen_types(argv))}
    parts = (argument.partition("=") for argument in argv)
    return [
        f"{name}{equals}{quoted_for_yaml(value, kinds.get(name[2:], ''))}" for name, equals, value in parts
    ]


def quoted_for_yaml(value: str, kind: str) -> str:
    """Quote the value of a setting if YAML would read another string from it.

    Args:
        value: as it was typed.
        kind: the setting's type, such as `str`, `Path` or `list[str]`; others are returned as they are.
    """
    try:
        read = yaml.safe_load(value)
    except yaml.YAMLError:
        read = ...
    if kind in TEXTS:
        quoted = isinstance(read, str) and value[0] in QUOTATION_MARKS
        none = read is None and "#" not in value  # a comment, which YAML reads as nothing too
        return value if none or read == value or quoted else json.dumps(value, ensure_ascii=False)
    listed = kind.startswith("list[") and kind[5:-1] in TEXTS and isinstance(read, list)
    if listed and not all(isinstance(each, str) for each in read):
        return format_value(yaml.load(value, yaml.BaseLoader))
    return value


def is_name(argument: str) -> bool:
    """Return whether an argument is a flag's name, without its value."""
    return argument.startswith("--") and "=" not in argument and argument != "--help"


def help_of(function: Callable[..., None], config_class: type) -> str:
    """Return the page that `--help` prints, with the flags of the types that are given beside it."""
    introduction = inspect.getdoc(inspect.getmodule(function)) or ""
    command = introduction.partition(":")[0].strip("`").removeprefix("lerobot-wmrl-")
    return help_page(config_class, introduction, command, chosen_types(sys.argv[1:]))


def parse_flags[Config: RunConfig](config_class: type[Config]) -> Config:
    """Parse the command line as LeRobot does, and note what it says of checkpoints.

    Raises:
        ValueError: it cannot be parsed; in one line, without argparse's page of usage, and with the reason
            that draccus keeps to itself.
    """

    @parser.wrap()
    def parsed(cfg: config_class) -> Config:  # type: ignore[valid-type]
        return cfg

    stderr = StringIO()
    try:
        with redirect_stderr(stderr), parsed_quickly():
            config = parsed()
    except SystemExit as stopped:
        reason = stopped.__context__ and cause(stopped.__context__)
        if isinstance(reason, FieldError):
            raise reason from None
        raise ValueError(parsing_error(stderr.getvalue().strip(), config_class)) from None
    config.given.update({name: given_path(name) for name in config.path_fields})
    return config
