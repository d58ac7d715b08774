"""Why a command line was refused, in one line and in the flags that were typed."""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from difflib import get_close_matches
from io import StringIO
from typing import Any

import draccus
from draccus.utils import ParsingError
from lerobot.configs import parser

from lerobot_wmrl.common.errors import FieldError, Stopped
from lerobot_wmrl.common.flags import TYPE, format_value
from lerobot_wmrl.common.presets import chosen_types, typed_flags
from lerobot_wmrl.common.quick_parsing import parsed_quickly
from lerobot_wmrl.common.settings import (
    Setting,
    known_types,
    settings_of,
    type_hints,
    without_none,
)

FIELD = re.compile(r"`([\w.]+)((?:=[^`]*)?)`")
"""A field in a message, alone or with a value: `dynamics.type=anchored`."""


def parsing_error(message: str, config_class: type[Any]) -> str:
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
    near = [near_flag(name, settings, config_class.other_names) for name in unknown]
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


def refusal(name: str, config_class: type[Any]) -> str | None:
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


def near_flag(name: str, settings: Sequence[Setting], other_names: Mapping[str, str]) -> str | None:
    """Return the flag that somebody may have meant who typed `name`, None if no flag is near.

    What `other_names` says counts first, then a flag that ends so, then one of the same group that is spelt
    nearly so, then the same last word in another group.
    """
    group, _, last = name.rpartition(".")
    lerobot_names = [other_names[name]] if name in other_names else []
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
