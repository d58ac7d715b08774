"""Recipes: YAML files that say what a dataset contains, read as the flags of `lerobot-wmrl-record`."""

import importlib.resources
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.suggestion import suggestion
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

NESTED = {"env": {"type", *(field.name for field in fields(WmrlManiSkillEnv))}}
KEYS = {field.name for field in fields(RecordConfig)} | set(NESTED)


def expand_recipes(argv: Sequence[str]) -> list[str]:
    """Replace `--recipe=FILE`, and `--preset=NAME` for a recipe of this package, by their flags in place."""
    expanded: list[str] = []
    for argument in argv:
        name, _, value = argument.partition("=")
        if name == "--recipe":
            expanded += recipe_flags(Path(value))
        elif name == "--preset":
            expanded += recipe_flags(packaged_recipe(value))
        else:
            expanded.append(argument)
    return expanded


def packaged_recipe(name: str) -> Path:
    """The recipe of that size. ValueError if there is none."""
    folder = Path(str(importlib.resources.files("lerobot_dataset_maniskill") / "recipes"))
    known = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in known:
        raise ValueError(f"--preset={name}: unknown preset; choose one of {', '.join(known)}")
    return folder / f"{name}.yaml"


def recipe_flags(path: Path) -> list[str]:
    """The file's keys as flags. ValueError if it cannot be read, or names an unknown key."""
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"--recipe={path}: cannot be read ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"--recipe={path}: must hold `key: value` lines")
    return [f"--{key}={_written(value)}" for key, value in _flat(content, path)]


def _flat(content: Mapping[str, Any], path: Path) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        _check_key(key, KEYS, path)
        if key not in NESTED:
            yield key, value
            continue
        for inner, setting in value.items():
            _check_key(inner, NESTED[key], path, f"{key}.")
            yield f"{key}.{inner}", setting


def _check_key(key: str, known: set[str], path: Path, prefix: str = "") -> None:
    if key in known:
        return
    hint = suggestion(key, sorted(known), prefix)
    raise ValueError(f"--recipe={path}: the key {prefix}{key} is unknown; {hint}")


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
