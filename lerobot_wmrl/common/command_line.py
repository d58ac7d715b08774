"""What every console command shares: parsing, help, errors without tracebacks."""

import inspect
import json
import logging
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, cached_property
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import draccus
import yaml
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_wmrl.common.errors import STOPPED, FieldError, Stopped
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.flags import TYPE, format_flags, format_value
from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE
from lerobot_wmrl.common.presets import read_settings
from lerobot_wmrl.common.quick_parsing import parsed_quickly
from lerobot_wmrl.common.settings import (
    Setting,
    help_page,
    known_types,
    settings_of,
    type_hints,
    without_none,
)

MAPPINGS = "input_features", "output_features", "normalization_mapping", "norm_stats"
"""Settings of LeRobot's policies and reward models whose value is a mapping."""

TEXTS = "str", "path", "Path"
"""Kinds of settings that are texts."""

QUOTATION_MARKS = "\"'"

FIELD = re.compile(r"`([\w.]+)((?:=[^`]*)?)`")
"""A field in a message, alone or with a value: `dynamics.type=anchored`."""


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


def parsing_error(message: str, config_class: type[RunConfig]) -> str:
    """Return in one line why the command line was refused, from the `message` of argparse or draccus."""
    group, reason = "", message.rpartition("error: ")[2]
    if undecoded := re.match(r"`(\w+)`: Could not decode the value into any.*?\n\s*\w+: (.*)", reason, re.S):
        group, reason = undecoded[1], refusal(undecoded[1], config_class) or undecoded[2]
    if inner := re.match(r"`([\w.]+)`: (.*)", reason, re.S):
        group, reason = ".".join(filter(None, (group, inner[1]))), inner[2]
    if optional := re.fullmatch(r"Could not decode the value into any[^\n]*\n\s*\w+: ([^\n]*)\s*", reason):
        reason = optional[1]  # of a setting that may be left out
    settings = list(settings_of(config_class, chosen_types(sys.argv[1:])))
    if "Expected a dict with a 'type' key" in reason:
        kinds = [each.name for each in settings if each.name.endswith(TYPE)]
        return "; ".join(
            f"--{flag} is a setting of a type: give --{kind}=…" for flag, kind in untyped(kinds, sys.argv[1:])
        )
    unknown = re.findall(r"--([\w.-]+)", reason) if reason.startswith("unrecognized arguments") else []
    if invalid := re.match(r"The fields? (.*) (?:is|are) not valid for", reason):
        unknown = [".".join(filter(None, (group, name))) for name in re.findall(r"`(\w+)`", invalid[1])]
    near = [near_flag(name, settings, config_class) for name in unknown]
    hints = [f"did you mean --{name}?" if name else "see --help" for name in near]
    problems = [f"there is no flag --{name}: {hint}" for name, hint in zip(unknown, hints, strict=True)]
    return "; ".join(problems) or " ".join(f"{f'--{group}: ' if group else ''}{reason}".split())


def untyped(kinds: Iterable[str], argv: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield flags that were typed although the type that they belong to was not, each with the type's flag.

    kinds: names of the flags for types.
    """
    typed, chosen = typed_flags(argv), chosen_types(argv)
    for group in (each.removesuffix(TYPE) for each in kinds):
        flag = next((name for name in typed if name.startswith(f"{group}.")), None)
        if flag and group not in chosen and f"{group}.path" not in typed:
            yield flag, f"{group}{TYPE}"


def refusal(name: str, config_class: type[RunConfig]) -> str | None:
    """Return why the configuration of an optional field refuses its settings: draccus only says that it does.

    Raises:
        FieldError: it says which setting cannot be.
    """
    chosen = (known_types(without_none(type_hints(config_class)[name])) or {}).get(parser.get_type_arg(name))
    if chosen is None:
        return None
    try:
        with parsed_quickly(), redirect_stderr(StringIO()):
            draccus.parse(chosen, args=parser.get_cli_overrides(name))
    except (ParsingError, SystemExit) as error:
        reason = cause(error)
        if isinstance(reason, FieldError):
            raise reason from None
        if isinstance(error, ParsingError):
            return str(error if "Couldn't parse" in str(error) else reason)
    return None


def near_flag(name: str, settings: Sequence[Setting], config_class: type[RunConfig]) -> str | None:
    """Return the flag that somebody may have meant who typed `name`, None if no flag is near.

    LeRobot's name for it counts first, then a flag that ends so, then one of the same group that is spelt
    nearly so, then the same last word in another group.
    """
    group, _, last = name.rpartition(".")
    lerobot_names = [config_class.other_names[name]] if name in config_class.other_names else []
    known = sorted((each.name for each in settings), key=lambda each: each.count("."))
    longer = [each for each in known if group and each.endswith(f".{name}")]
    beside = {each.rpartition(".")[2]: each for each in known if each.rpartition(".")[0] == group}
    spelt = [beside[each] for each in get_close_matches(last, beside, 1)]
    elsewhere = [each for each in known if group and each.rpartition(".")[2] == last]
    return next(iter([*lerobot_names, *longer, *spelt, *elsewhere]), None)


def cause(error: BaseException) -> BaseException:
    """Return the reason behind what draccus raises: the FieldError among its causes, else the next cause."""
    each: BaseException | None = error
    while each is not None and not isinstance(each, FieldError):
        each = each.__cause__ or each.__context__
    return each or (error.__cause__ if isinstance(error, ParsingError) and error.__cause__ else error)


def chosen_types(argv: Sequence[str]) -> dict[str, str]:
    """Return the types that a command line chooses, also by its `--config_path`: field → type."""
    flags = typed_flags(argv)
    path = Path(str(flags.get("config_path", "")))
    stored = read_settings(path) if path.suffix in (".yaml", ".yml", ".json") and path.is_file() else {}
    return {
        name.removesuffix(TYPE): str(value)
        for name, value in {**stored, **flags}.items()
        if name.endswith(TYPE)
    }


def typed_flags(argv: Sequence[str]) -> dict[str, str]:
    """Return the flags of a command line: name → value, of what is typed twice the last."""
    split = [argument[2:].partition("=") for argument in argv if argument.startswith("--")]
    return {name: value for name, _, value in split}


def said_in_flags(error: BaseException, config_class: type, argv: Sequence[str]) -> str:
    """Return an error's message, with fields as the flags that set them: `reward.form` → `--env.reward.form`.

    Args:
        error: a FieldError knows its field, relative to the configuration that raised it, and names others in
            backquotes, as `Stopped` does. Any other error keeps its message.
        config_class: class of the command's settings.
        argv: what was typed.
    """
    if not isinstance(error, FieldError | Stopped):
        return str(error)
    typed = typed_flags(argv)
    known = {each.name: each.default for each in settings_of(config_class, chosen_types(argv))}
    known |= {name.rpartition(".")[0]: None for name in known if "." in name}
    field, value = (error.field, error.value) if isinstance(error, FieldError) else ("", None)
    flag = field and (flag_of(field, value, typed) or flag_of(field, value, known))
    groups = (flag or "").removesuffix(field).split(".")[:-1]

    def as_flag(match: re.Match[str]) -> str:
        nearest = (".".join([*groups[:count], match[1]]) for count in range(len(groups), -1, -1))
        option = next((name for name in nearest if name in known or name in typed), None)
        option = option or flag_of(match[1], None, typed) or flag_of(match[1], None, known)
        return f"--{option}{match[2]}" if option else match[0]

    if isinstance(error, Stopped):
        return re.sub(FIELD, as_flag, str(error))
    problem, remedy = (re.sub(FIELD, as_flag, text) for text in (error.problem, error.remedy))
    shown = "" if value in (None, "") else f"={format_value(value)}"
    message = f"{f'--{flag}' if flag else field}{shown}: {problem}"
    return f"{message}; {remedy}" if remedy else message


def flag_of(field: str, value: object, flags: Mapping[str, Any]) -> str | None:
    """Return the flag that ends with a field's name, one with that value first, then the shortest."""
    matches = [name for name in flags if name == field or name.endswith(f".{field}")]
    return min(
        matches,
        key=lambda name: (format_value(flags[name]) != format_value(value), name.count(".")),
        default=None,
    )
