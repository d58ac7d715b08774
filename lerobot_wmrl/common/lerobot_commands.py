"""LeRobot's own commands as stages: each can be called again after an interruption."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT
from lerobot_wmrl.common.presets import Flags, format_flags


def train_command(folder: Path, flags: Sequence[str]) -> list[str]:
    """Return lerobot-train with these flags and this output folder, begun or continued.

    It continues by other flags from a whole checkpoint, and refuses a folder without one, which is therefore
    removed. Whole are the one that `last` points to and, where a kill left no link, all but the newest.
    """
    steps = sorted(each for each in (folder / CHECKPOINTS_DIR).glob("*") if each.name.isdigit())
    last = folder / LAST_CHECKPOINT
    whole = [last] if last.exists() else steps[-2:-1]
    if whole:
        trained = whole[0] / PRETRAINED_MODEL_DIR / "train_config.json"
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
