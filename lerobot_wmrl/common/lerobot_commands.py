"""LeRobot's own commands as stages, each of which can be called again after an interruption, and its
environments as flags."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import draccus
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT, step_folders
from lerobot_wmrl.common.hub import cached_repo
from lerobot_wmrl.common.presets import Flags, format_lerobot_flags

DERIVED = ("features", "features_map")
"""Settings of an environment that are derived from others."""


def train_command(folder: Path, flags: Sequence[str]) -> list[str]:
    """Return lerobot-train with these flags and this output folder, or, by other flags, on from a whole
    checkpoint there. It refuses a folder without one."""
    if whole := whole_checkpoint(folder):
        trained = whole / PRETRAINED_MODEL_DIR / "train_config.json"
        return ["lerobot-train", *format_lerobot_flags({"config_path": str(trained), "resume": True})]
    return ["lerobot-train", *flags, *format_lerobot_flags({"output_dir": str(folder)})]


def whole_checkpoint(folder: Path) -> Path | None:
    """Return the newest checkpoint of lerobot-train that is whole for certain: the one that `last` points to
    or, where a kill left no link, the one before the newest."""
    last = folder / LAST_CHECKPOINT
    return last if last.exists() else next(iter(step_folders(folder)[-2:-1]), None)


def merge_command(folder: Path, datasets: Mapping[str, Path]) -> list[str]:
    """Return lerobot-edit-dataset that merges datasets, name → folder, into a new one."""
    return edit_command(folder, "merge", {
        "operation.repo_ids": [f"local/{name}" for name in datasets],
        "operation.roots": [str(root) for root in datasets.values()],
        "operation.concatenate_data": False,
    })  # fmt: skip


def edit_command(folder: Path, operation: str, flags: Flags) -> list[str]:
    """Return lerobot-edit-dataset into a new folder. It refuses what an interrupted call left there."""
    new = {"new_repo_id": f"local/{folder.name}", "new_root": str(folder), "operation.type": operation}
    return ["lerobot-edit-dataset", *format_lerobot_flags(new | dict(flags))]


def edit_advice(root: str | Path, operation: str, flags: Flags) -> str:
    """Return lerobot-edit-dataset as one types it, to make a changed copy of a dataset on disk: beside it, or
    in the folder `data` of one in the hub's cache, which is cleaned."""
    source = Path(root).absolute() if not Path(root).name else Path(root)
    repo = cached_repo(source.absolute())
    copied = source if repo is None else Path("data") / repo.rpartition("--")[2]
    flags = {"repo_id": f"local/{copied.name}", "root": str(source), **flags}
    return shlex.join(edit_command(copied.with_name(f"{copied.name}_edited"), operation, flags))


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
