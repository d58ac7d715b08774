"""The settings of a configuration class, every flag with its type, default and explanation, and `--help`.

Draccus finds the explanations by scanning source code for every flag again; here each class is read once, and
docstrings with `Args:` count too.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from draccus.choice_types import ChoiceType

from lerobot_wmrl.common.flags import format_value
from lerobot_wmrl.common.presets import FOLDER, presets_of

WIDTH = 110
"""Characters a line of `--help`."""

ARGUMENT = re.compile(r"((?:\w+(?:, *)?)+):\s+(.*)")
"""`name: text`, or `name, other: text`, at the left of a docstring's `Args:`."""


@dataclass(frozen=True)
class Setting:
    """One flag.

    Args:
        name: dotted, without dashes.
        kind: its type, as shown to a user.
        default: MISSING where there is none.
        explanation: one paragraph; empty if the source has none.
        depth: depth of the configuration that holds it, 0 for the command's own.
    """

    name: str
    kind: str
    default: Any
    explanation: str
    depth: int


def settings_of(
    config: Any, types: Mapping[str, str] | None = None, prefix: str = "", depth: int = 0
) -> Iterator[Setting]:
    """Yield the settings of a configuration, nested ones after the one that holds them.

    Args:
        config: a dataclass, or an instance whose values are the defaults.
        types: dotted name of a field → the registered type that is chosen for it (`{"env": "world_model"}`).
        prefix, depth: what the names begin with, and how many configurations hold them.
    """
    types = types or {}
    cls = config if isinstance(config, type) else type(config)
    hints, explanations = type_hints(cls), explanations_of(cls)
    for field in fields(cls):
        if not field.init:
            continue
        name, hint = f"{prefix}{field.name}", without_none(hints.get(field.name, field.type))
        # LeRobot's configurations put the device that this machine has in place of a default of None
        from_class = isinstance(config, type) or field.name == "device"
        value = default_of(field) if from_class else getattr(config, field.name)
        explanation = explanations.get(field.name, "")
        known = known_types(hint)
        if known is not None:
            chosen = types.get(name) or registered_name(known, type(value))
            yield Setting(f"{name}.type", "|".join(known), chosen, explanation, depth)
            if chosen in known:
                same = type(value) is known[chosen]
                yield from settings_of(value if same else known[chosen], types, f"{name}.", depth + 1)
        elif is_dataclass(hint):
            inner = hint if value is MISSING or value is None else value
            yield from introduced(settings_of(inner, types, f"{name}.", depth + 1), explanation)
        else:
            yield Setting(name, kind_of(hint), value, explanation, depth)


def introduced(settings: Iterator[Setting], introduction: str) -> Iterator[Setting]:
    """Yield a group's settings, with the group's `introduction` before the first one's explanation."""
    for number, setting in enumerate(settings):
        explanation = setting.explanation
        both = " ".join(filter(None, (introduction, explanation[:1].upper() + explanation[1:])))
        yield setting if number else replace(setting, explanation=both)


def known_types(hint: Any) -> dict[str, type] | None:
    """Return the types registered under a choice, None if the annotation is not a choice."""
    is_choice = isinstance(hint, type) and issubclass(hint, ChoiceType)
    return hint.get_known_choices() if is_choice else None


def type_hints(cls: type) -> dict[str, Any]:
    """Return the annotations of a class with its bases', resolved where they can be."""
    try:
        return get_type_hints(cls)
    except (NameError, TypeError):
        return {field.name: field.type for field in fields(cls)}


def without_none(hint: Any) -> Any:
    """Return `X` for `X | None`, anything else as it is."""
    if get_origin(hint) not in (Union, UnionType):
        return hint
    members = [each for each in get_args(hint) if each is not NoneType]
    return members[0] if len(members) == 1 else hint


def default_of(field: "Field[Any]") -> Any:
    """Return what a field is without a flag. MISSING if it must be given."""
    return field.default_factory() if field.default_factory is not MISSING else field.default


def registered_name(known: Mapping[str, type], cls: type) -> str | None:
    """Return the name under which a class is registered, None if it is not."""
    return next((name for name, each in known.items() if each is cls), None)


def kind_of(hint: Any) -> str:
    """Return a type as a user would say it: `int`, `a|b`, `list[str]`."""
    if get_origin(hint) is Literal:
        return "|".join(map(str, get_args(hint)))
    if isinstance(hint, type) and not get_args(hint):
        return hint.__name__.lower()
    return re.sub(r"\b\w+\.|typing\.", "", str(hint))


@cache
def explanations_of(cls: type) -> dict[str, str]:
    """Return what the source of a class and its bases says of each field: name → one paragraph."""
    texts: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        if is_dataclass(each):
            texts |= explained_in_source(each) | explained_in_docstring(each.__dict__.get("__doc__") or "")
    return texts


def explained_in_docstring(text: str) -> dict[str, str]:
    """Read the section `Args:` of a Google-style docstring."""
    _, _, section = inspect.cleandoc(text).partition("Args:\n")
    explanations: dict[str, list[str]] = {}
    names: list[str] = []
    for line in textwrap.dedent(section).splitlines():
        if line and not line.startswith(" "):
            argument = ARGUMENT.match(line)
            if not argument:
                break  # the next section
            names = re.split(r", *", argument[1])
            explanations |= {name: [argument[2]] for name in names}
        elif line.strip():
            for name in names:
                explanations[name].append(line.strip())
    return {name: " ".join(lines) for name, lines in explanations.items()}


def explained_in_source(cls: type) -> dict[str, str]:
    """Read the string below each field, else the comment beside it, else the comments above it."""
    try:
        lines = textwrap.dedent(inspect.getsource(cls)).splitlines()
        (definition,) = ast.parse("\n".join(lines)).body
    except (OSError, TypeError, SyntaxError, ValueError):
        return {}
    assert isinstance(definition, ast.ClassDef)
    explanations = {}
    for node, following in zip(definition.body, [*definition.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            explanation = string_of(following) or comment_in(lines[(node.end_lineno or node.lineno) - 1])
            explanations[node.target.id] = explanation or comments_above(lines, node.lineno - 1)
    return {name: explanation for name, explanation in explanations.items() if explanation}


def string_of(node: ast.AST | None) -> str:
    """Return the text of a statement that is nothing but a string, as one paragraph."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return " ".join(str(node.value.value).split())
    return ""


def comment_in(line: str) -> str:
    """Return the comment at the end of a line."""
    return line.partition("  # ")[2].strip()


def comments_above(lines: list[str], index: int) -> str:
    """Return the comment lines directly above line `index`, as one paragraph."""
    first = index
    while first > 0 and lines[first - 1].lstrip().startswith("# "):
        first -= 1
    return " ".join(line.strip().removeprefix("# ") for line in lines[first:index])


def help_page(config_class: type, introduction: str, command: str, types: Mapping[str, str]) -> str:
    """Write what `--help` prints: introduction and examples, presets, every flag with its default."""
    settings = list(settings_of(config_class, types))
    paths = getattr(config_class, "path_fields", ())
    lines = [introduction.strip(), "", *preset_lines(command), "Flags, each as --name=value:", ""]
    direct = inspect.get_annotations(config_class)
    # the command's own flags first, then those that it inherits, then nested ones
    for setting in sorted(settings, key=lambda each: (each.depth > 0, each.name.split(".")[0] not in direct)):
        lines += flag_lines(setting)
        group, _, last = setting.name.rpartition(".")
        if last == "type" and group in paths:
            lines += [
                f"  --{group}.path  str  (default: none)",
                f"      a checkpoint, in place of --{group}.type.",
            ]
    lines += ["  --config_path  path  (default: none)", "      a YAML or JSON file with these settings.", ""]
    kinds = [f"--{each.name}=…" for each in settings if each.name.endswith(".type")]
    if kinds:
        lines += [f"A type has flags of its own. To list them, add it to --help: {', '.join(kinds)}"]
    return "\n".join(lines).rstrip()


def preset_lines(command: str) -> list[str]:
    """Say which presets a command has."""
    presets = presets_of(command)
    if not presets:
        return []
    typed = any(presets.values())
    whole = all((FOLDER / size / f"{command}.yaml").is_file() for size in presets)
    kind = ("[.<type>]" if whole else ".<type>") if typed else ""
    return [
        f"Presets: --preset={'|'.join(presets)}{'' if whole else ' (give the type too)'} stands for the "
        f"settings in {FOLDER.name}/<preset>/{command}{kind}.yaml;",
        "flags further right override them.",
        "",
    ]


def flag_lines(setting: Setting) -> list[str]:
    """Write one flag: its type and default in a line, its explanation indented below."""
    default = "required" if setting.default is MISSING else f"default: {shown(setting.default)}"
    listed = "|" in setting.kind and " | " not in setting.kind  # a union of types is not a list of choices
    of_type = setting.name.rpartition(".")[2] == "type"
    known = "Registered types:" if of_type else "One of"
    choices = f"{known} {', '.join(setting.kind.split('|'))}." if listed else ""
    head = f"  --{setting.name}  {'' if choices else f'{setting.kind}  '}({default})"
    explanation = f"{setting.explanation} {choices}".strip()
    return [
        line
        for text, indent in ((head, ""), (explanation, "      "))
        for line in textwrap.wrap(
            text, WIDTH, initial_indent=indent, subsequent_indent="      ", break_on_hyphens=False
        )
    ]


def shown(value: Any) -> str:
    """Write a default as it would be typed; `none` for nothing."""
    if value is None or value == "":
        return "none"
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, dict):
        inner = ", ".join(f"{key}: {shown(each)}" for key, each in value.items())
        return f"{{{inner}}}"
    if is_dataclass(value) and not isinstance(value, type):
        return shown({field.name: getattr(value, field.name) for field in fields(value)})
    return format_value(value)
