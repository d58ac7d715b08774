"""Presets: YAML files of settings, one a command and size, that `--preset` and `--config_path` both read.

`--preset=demo` is replaced, in place, by the flags of `lerobot_wmrl/presets/demo/<command>.yaml`: what stands
further right overrides it. Where a command differs by what it trains, the file is `<command>.<type>.yaml`.
Every file is a configuration that LeRobot's `--config_path=FILE` reads too.
"""

from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import yaml

from lerobot_wmrl.common.flags import TYPE, format_flags

PRESETS: Final = ("tiny", "demo", "cpu", "gpu", "paper")
"""From seconds to the published sizes."""

FOLDER: Final = Path(str(files("lerobot_wmrl") / "presets"))


def expand_preset(argv: Sequence[str], command: str) -> list[str]:
    """Replace `--preset=NAME` in `argv` by that preset's flags for `command`.

    Where another type is typed than the preset's (`--algorithm.type=grpo`), the preset's settings of its own
    type are left out.
    """
    split = [argument.partition("=") for argument in argv]
    types = {name.removeprefix("--"): value for name, _, value in split if name.endswith(TYPE)}
    expanded: list[str] = []
    for argument, (name, separator, value) in zip(argv, split, strict=True):
        if name == "--preset" and separator:
            settings = preset_settings(value, command, list(types.values()))
            expanded += format_flags(without_other_types(settings, types))
        else:
            expanded.append(argument)
    return expanded


def without_other_types(settings: Mapping[str, Any], types: Mapping[str, str]) -> dict[str, Any]:
    """Return the settings except those below a `….type` that `types` sets to another value."""
    replaced = tuple(
        name.removesuffix(TYPE) + "." for name in types if settings.get(name, types[name]) != types[name]
    )
    return {name: value for name, value in settings.items() if not name.startswith(replaced)}


def preset_settings(preset: str, command: str, types: Sequence[str] = ()) -> dict[str, Any]:
    """Read a preset of a command.

    Args:
        preset: one of `PRESETS`.
        command: name of the console command, without `lerobot-wmrl-`.
        types: what is trained, where the command's presets differ by it (`action_world_model`, `openvla`).

    Returns:
        Dotted name of each setting → its value.

    Raises:
        ValueError: there is no such preset of that command.
    """
    return read_settings(preset_file(preset, command, types))


def preset_file(preset: str, command: str, types: Sequence[str] = ()) -> Path:
    """Return the file of a preset, that of one of the `types` first. Raises ValueError if there is none."""
    if preset not in PRESETS:
        raise ValueError(f"--preset={preset}: unknown preset; choose one of {', '.join(PRESETS)}")
    names = [*(f"{command}.{each}.yaml" for each in types), f"{command}.yaml"]
    for name in names:
        if (FOLDER / preset / name).is_file():
            return FOLDER / preset / name
    known = [path.name.split(".")[1] for path in sorted((FOLDER / preset).glob(f"{command}.*.yaml"))]
    if known and not types:
        raise ValueError(f"--preset={preset}: {command} has one a type; give a type: {', '.join(known)}")
    sizes = [size for size in PRESETS if any((FOLDER / size / name).is_file() for name in names)]
    raise ValueError(f"--preset={preset}: {command} has no such preset; it has: {', '.join(sizes) or 'none'}")


def presets_of(command: str) -> dict[str, list[str]]:
    """Return the presets of a command, each with the types that have a file of their own."""
    files = {size: sorted((FOLDER / size).glob(f"{command}.*yaml")) for size in PRESETS}
    return {
        size: [kind for _, *kinds, _ in (path.name.split(".") for path in paths) for kind in kinds]
        for size, paths in files.items()
        if paths
    }


def read_settings(path: Path, whole: Sequence[str] = ()) -> dict[str, Any]:
    """Read a YAML file of settings.

    Args:
        path: the file: a mapping, nested as the configuration is.
        whole: dotted names of settings whose value is itself a mapping.

    Returns:
        Dotted name of each setting → its value.

    Raises:
        ValueError: the file cannot be read or is not a mapping.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must hold `key: value` lines")
    return dict(_flat(content, whole))


def _flat(content: Mapping[str, Any], whole: Sequence[str], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and name not in whole:
            yield from _flat(value, whole, f"{name}.")
        else:
            yield name, value


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
