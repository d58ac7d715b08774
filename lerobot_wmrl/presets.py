"""Presets: one place for the flags of every command at every size.

A preset is nothing but flags: `--preset=demo` is replaced, in place, by the flags listed here for that
command, so whatever a preset sets can also be set (and overridden, further right) by hand.
"""

from collections.abc import Mapping, Sequence
from typing import Final

Flags = Mapping[str, str | int | float | bool]

PRESETS: Final[dict[str, dict[str, Flags]]] = {
    "tiny": {},
    "demo": {},
}


def format_flags(flags: Flags) -> list[str]:
    """`{"a.b": 1, "c": True}` → `["--a.b=1", "--c=true"]`, the form draccus parses."""
    return [f"--{name}={str(value).lower() if isinstance(value, bool) else value}" for name, value in flags.items()]


def preset_flags(preset: str, command: str) -> list[str]:
    """The flags of `command` (for example `record`) at size `preset`. ValueError if there are none."""
    if preset not in PRESETS:
        raise ValueError(f"--preset={preset}: unknown preset; choose one of {', '.join(PRESETS)}")
    if command not in PRESETS[preset]:
        sizes = ", ".join(name for name, commands in PRESETS.items() if command in commands)
        raise ValueError(f"--preset={preset}: {command} has no such preset; it has: {sizes}")
    return format_flags(PRESETS[preset][command])


def expand_preset(argv: Sequence[str], command: str) -> list[str]:
    """Replace `--preset=NAME` in `argv` by that preset's flags, which later flags override."""
    expanded: list[str] = []
    for argument in argv:
        name, separator, value = argument.partition("=")
        expanded += preset_flags(value, command) if name == "--preset" and separator else [argument]
    return expanded
