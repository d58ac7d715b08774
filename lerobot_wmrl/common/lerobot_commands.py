"""LeRobot's own commands as stages: each can be called again after an interruption."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT, last_checkpoint
from lerobot_wmrl.common.presets import Flags, format_flags


def train_command(folder: Path, flags: Sequence[str]) -> list[str]:
    """Return lerobot-train with these flags and this output folder, begun or continued.

    It continues by other flags, from the checkpoint that `last` points to once it is whole. It refuses a
    folder without one, which is therefore removed.
    """
    if (folder / LAST_CHECKPOINT).exists():
        trained = last_checkpoint(folder) / "train_config.json"
        return ["lerobot-train", *format_flags({"config_path": str(trained), "resume": True})]
    shutil.rmtree(folder, ignore_errors=True)
    return ["lerobot-train", *flags, *format_flags({"output_dir": str(folder)})]


def merge_command(folder: Path, datasets: Mapping[str, Path]) -> list[str]:
    """Return lerobot-edit-dataset that merges datasets, name → folder, into a new one."""
    return edit_command(folder, "merge", {
        "operation.repo_ids": str([f"local/{name}" for name in datasets]),
        "operation.roots": str([str(root) for root in datasets.values()]),
        "operation.concatenate_data": False,
    })  # fmt: skip


def edit_command(folder: Path, operation: str, flags: Flags) -> list[str]:
    """Return lerobot-edit-dataset into a new folder. It refuses what an interrupted call left there, which is
    removed first."""
    shutil.rmtree(folder, ignore_errors=True)
    new = {"new_repo_id": f"local/{folder.name}", "new_root": str(folder), "operation.type": operation}
    return ["lerobot-edit-dataset", *format_flags(new | dict(flags))]
