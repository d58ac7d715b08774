"""Recipes: YAML files that say what a dataset contains, read as the flags of `lerobot-wmrl-record`."""

import importlib.resources
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.presets import format_flags, read_settings
from lerobot_wmrl.common.suggestion import suggestion
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

KEYS = {
    *(field.name for field in fields(RecordConfig)),
    *(f"env.{name}" for name in ("type", *(field.name for field in fields(WmrlManiSkillEnv)))),
}


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
    """Return the file's keys as flags. Raises ValueError if it cannot be read, or names an unknown key."""
    try:
        settings = read_settings(path, whole=("kinds",))
    except ValueError as error:
        raise ValueError(f"--recipe={error}") from error
    for name in settings:
        if name not in KEYS:
            prefix, _, key = name.rpartition(".")
            beside = sorted(each.rpartition(".")[2] for each in KEYS if each.rpartition(".")[0] == prefix)
            hint = suggestion(key, beside, prefix and f"{prefix}.")
            raise ValueError(f"--recipe={path}: the key {name} is unknown; {hint}")
    return format_flags(settings)
