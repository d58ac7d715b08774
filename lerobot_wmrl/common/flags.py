"""Settings as flags of a command line: of this package's commands, of LeRobot's, and as one types them."""

import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, Final

import draccus
import yaml
from lerobot.envs.configs import EnvConfig

type Flags = Mapping[str, str | int | float | bool | list[int] | list[str]]

TYPE: Final = ".type"
"""Ends the flags that choose one of several classes, which share a prefix but not their settings."""

TAKEN_AS_TYPED: Final = re.compile(r"(^|\.)(path|config_path)$")
"""Flags that LeRobot takes from the command line before draccus reads it."""

DERIVED: Final = ("features", "features_map")
"""Settings of an environment that are derived from others."""


def format_flags(settings: Mapping[str, Any]) -> list[str]:
    """Write settings as draccus parses them: `{"a.b": 1, "c": True}` → `["--a.b=1", "--c=true"]`."""
    return [f"--{name}={format_value(value)}" for name, value in settings.items()]


def format_lerobot_flags(settings: Mapping[str, Any]) -> list[str]:
    """Write settings for a command of LeRobot's own, which reads texts as YAML, as ours do not: a dataset in
    `2024_01_15` has quotation marks. It takes checkpoints (`policy.path`) as they are."""
    return [
        f"--{name}={_format_text(str(value), listed=False)}"
        if isinstance(value, str | Path) and not TAKEN_AS_TYPED.search(name)
        else f"--{name}={format_value(value)}"
        for name, value in settings.items()
    ]


def program_call(program: str, settings: Mapping[str, Any]) -> list[str]:
    """Return one of our commands with these settings."""
    return [program, *format_flags(settings)]


def flag_as_typed(name: str, value: Any) -> str:
    """Return a flag as one types it in a shell, whatever its value has in it: `'--dataset.root=my data'`."""
    return shlex.join(format_flags({name: value}))


def format_value(value: Any) -> str:
    """Write a setting as YAML in one line."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_format_element, value))}]"
    return json.dumps(value) if isinstance(value, bool | dict | None) else str(value)


def _format_element(value: Any) -> str:
    return _format_text(str(value), listed=True) if isinstance(value, str | Path) else format_value(value)


def _format_text(text: str, listed: bool) -> str:
    """Write a text, in quotation marks if YAML would not read it as the same one."""
    written, meant = (f"[{text}]", [text]) if listed else (text, text)
    try:
        plain = yaml.safe_load(written) == meant
    except yaml.YAMLError:
        plain = False
    return text if plain else json.dumps(text, ensure_ascii=False)


def flat(settings: Any, encoded: Mapping[str, Any]) -> dict[str, Any]:
    """Return encoded settings by their flags' names; those that are mappings stay whole, as one flag each."""
    found: dict[str, Any] = {}
    for name, value in encoded.items():
        part = getattr(settings, name, None)
        if is_dataclass(part):
            found |= {f"{name}.{inner}": each for inner, each in flat(part, value).items()}
        else:
            found[name] = value
    return found


def env_flags(env: EnvConfig, prefix: str = "env") -> Flags:
    """Return `env.type` and the settings that differ from their defaults, as a command takes them.

    prefix: prefix of the flags, `env` or `real_env`.
    """
    given, default = (flat(each, draccus.encode(each, EnvConfig)) for each in (env, type(env)()))
    differing = [name for name in given if given[name] != default.get(name)]
    chosen = {
        name
        for name in given
        if name.endswith(".type") and any(each.startswith(name.removesuffix("type")) for each in differing)
    }
    kept = [name for name in given if name in {*differing, *chosen} and name.split(".")[0] not in DERIVED]
    return {f"{prefix}.type": env.type, **{f"{prefix}.{name}": given[name] for name in kept}}
