"""LeRobot's own commands as stages, each of which can be called again after an interruption."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT, step_folders
from lerobot_wmrl.common.flags import Flags, format_lerobot_flags
from lerobot_wmrl.common.hub import cached_repo


def train_command(folder: Path, settings: Mapping[str, Any]) -> list[str]:
    """Return lerobot-train with these settings and this output folder, or, by other flags, on from a whole
    checkpoint there. It refuses a folder without one."""
    if whole := whole_checkpoint(folder):
        trained = whole / PRETRAINED_MODEL_DIR / "train_config.json"
        return ["lerobot-train", *format_lerobot_flags({"config_path": str(trained), "resume": True})]
    return ["lerobot-train", *format_lerobot_flags({**settings, "output_dir": str(folder)})]


def whole_checkpoint(folder: Path) -> Path | None:
    """Return the newest checkpoint of lerobot-train that is whole for certain: the one that `last` points to
    or, where a kill left no link, the one before the newest."""
    last = folder / LAST_CHECKPOINT
    return last if last.exists() else next(iter(step_folders(folder)[-2:-1]), None)


def merge_command(folder: Path, datasets: Mapping[str, Path]) -> list[str]:
    """Return lerobot-edit-dataset that merges datasets, name → folder, into a new one."""
    return edit_command(
        folder,
        "merge",
        {
            "operation.repo_ids": [f"local/{name}" for name in datasets],
            "operation.roots": [str(root) for root in datasets.values()],
            "operation.concatenate_data": False,
        },
    )


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
