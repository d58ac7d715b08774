"""Checkpoints that are either whole or absent, in LeRobot's layout."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.common.train_utils import get_step_checkpoint_dir
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from safetensors import SafetensorError
from safetensors.torch import load_file

LAST_CHECKPOINT = f"{CHECKPOINTS_DIR}/{LAST_CHECKPOINT_LINK}"


def resolve_checkpoint(path: str | Path) -> Path:
    """A training's output folder, or one of its checkpoints → the `pretrained_model` folder inside."""
    root = Path(path)
    for candidate in (root, root / PRETRAINED_MODEL_DIR, root / LAST_CHECKPOINT / PRETRAINED_MODEL_DIR):
        if (candidate / "config.json").is_file():
            return candidate
    return root


def write_checkpoint(output_dir: Path, total_steps: int, step: int, write: Callable[[Path], None]) -> Path:
    """Let `write` fill a temporary folder, then move it to `checkpoints/<step>` and point `last` at it."""
    target = get_step_checkpoint_dir(output_dir, total_steps, step)
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    write(partial)
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
    link = target.with_name(f".{LAST_CHECKPOINT_LINK}.partial")
    link.unlink(missing_ok=True)
    link.symlink_to(target.name)
    link.replace(target.with_name(LAST_CHECKPOINT_LINK))
    return target


def read_weights(checkpoint: Path) -> dict[str, Any]:
    """The tensors of a checkpoint's model. ValueError if the file is truncated."""
    path = checkpoint / PRETRAINED_MODEL_DIR / SAFETENSORS_SINGLE_FILE
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"{path}: cannot be read ({error}); remove {checkpoint} to continue from the one before"
        ) from error


def latest_checkpoint(output_dir: Path) -> Path | None:
    """The whole checkpoint of the highest step, or None."""
    folder = output_dir / CHECKPOINTS_DIR
    steps = [path for path in folder.glob("*") if path.name.isdigit()] if folder.is_dir() else []
    return max(steps, key=lambda path: int(path.name), default=None)
