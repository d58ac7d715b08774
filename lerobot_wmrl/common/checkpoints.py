"""Checkpoints that are either whole or absent, in LeRobot's layout."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import torch
from huggingface_hub import snapshot_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError

ADAPTERS_FILE = "adapter_model.safetensors"
"""PEFT's: where a policy has adapters, its checkpoints hold them alone."""

SETTINGS: Final = ("config.json", "adapter_config.json")
"""A checkpoint's files of settings."""

PARTS: Final = (
    "base_model_name_or_path",
    "world_model_path",
    "text_world_model_path",
    "proposal_path",
)
"""Settings of policies that name further checkpoints."""

MODEL_FILES: Final = (*SETTINGS, "*processor.json", "*.safetensors")
"""A checkpoint's files that say how its model acts: settings, processors with their numbers, weights."""

LAST_CHECKPOINT = f"{CHECKPOINTS_DIR}/{LAST_CHECKPOINT_LINK}"

UNPUBLISHED: Final = ("--push_to_hub=false", "--repo_id=null")
"""Flags of a model that is trained further: the one before would be overwritten where it was published."""

BEST_CHECKPOINT_LINK = "best"
"""Beside LeRobot's `last`: the checkpoint of a policy that succeeded most often on the selection seeds."""


@dataclass
class Checkpoint:
    """A trained model.

    Args:
        path: output folder of its training, or one of its checkpoints.
    """

    path: str = ""


def may_be_on_hub(name: str | Path) -> bool:
    """Return whether a name can be one of the hub's, `model` or `owner/model`. All others are paths, and so
    is what begins with `outputs`, where commands write by default."""
    parts = Path(name).parts
    return len(parts) <= 2 and not str(name).startswith((".", "/")) and parts[:1] != ("outputs",)


def model_folder(path: str | Path) -> Path:
    """Return the `pretrained_model` folder inside a training's output folder or one of its checkpoints."""
    root = Path(path)
    for candidate in (root, root / PRETRAINED_MODEL_DIR, last_model(root)):
        if (candidate / "config.json").is_file():
            return candidate
    return root


def settled_folder(path: str) -> Path:
    """Return `model_folder` with its links resolved, since a longer training moves `last` on; relative to the
    working directory if `path` is."""
    folder = model_folder(path)
    if not folder.is_dir():
        return folder
    settled = folder.resolve()
    below = not folder.is_absolute() and settled.is_relative_to(Path.cwd())
    return settled.relative_to(Path.cwd()) if below else settled


def resolved_path(path: str) -> str:
    """Return the folder of a checkpoint's model, with `config.json` in it, as LeRobot's commands take it.

    A training's output folder and its link `last` become the checkpoint behind them: a longer training moves
    the link on. A path that is no folder is returned as it is: it may be a hub id.
    """
    folder = settled_folder(path)
    if not folder.is_dir():
        return path
    below = folder.is_absolute() and folder.is_relative_to(Path.cwd())
    return str(folder.relative_to(Path.cwd()) if below else folder)


def resolved_name(path: str) -> str:
    """Return a checkpoint's folder as users name it: `resolved_path` without LeRobot's `pretrained_model`."""
    folder = Path(resolved_path(path))
    return str(folder.parent if folder.name == PRETRAINED_MODEL_DIR else folder)


def local_model_folder(
    path: str | Path, files: Sequence[str] | None = None, revision: str | None = None
) -> Path:
    """Return the folder with a checkpoint's model. One on the hub is downloaded into its cache, all of it or
    the files of some patterns, of a branch, tag or commit if it is given."""
    folder = model_folder(path)
    if folder.is_dir():
        return folder
    return Path(snapshot_download(str(path), revision=revision, allow_patterns=files))


@contextmanager
def reading_weights(described: Callable[[Exception], Exception]) -> Iterator[None]:
    """Raise what `described` makes of an error that says that weights cannot be read, or do not fit."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except (SafetensorError, RuntimeError, OSError) as error:
        raise described(error) from error


def given_revision(overrides: Sequence[str]) -> str | None:
    """Return the last `--pretrained_revision` among flags; None if there is none."""
    revision = None
    for flag, following in pairwise([*overrides, ""]):
        name, is_same, value = flag.partition("=")
        if name == "--pretrained_revision":
            revision = value if is_same else following
    return None if revision in ("", "null") else revision


def last_model(folder: Path) -> Path:
    """Return the model of the last checkpoint of a training command that writes to `folder`."""
    return folder / LAST_CHECKPOINT / PRETRAINED_MODEL_DIR


def best_model(folder: Path) -> Path:
    """Return the model of the best checkpoint of a training with selection that writes to `folder`."""
    return folder / CHECKPOINTS_DIR / BEST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR


def checkpoint_name(total_steps: int, step: int) -> str:
    """Return the name of a step's checkpoint folder: `000500`, wider only where steps have more digits."""
    return f"{step:0{max(6, len(str(total_steps)))}d}"


def checkpoint_dir(output_dir: Path, total_steps: int, step: int) -> Path:
    """Return the folder of a step's checkpoint."""
    return output_dir / CHECKPOINTS_DIR / checkpoint_name(total_steps, step)


def should_save_checkpoint(step: int, save_freq: int, total_steps: int) -> bool:
    """Return whether a step is the last one or one of every `save_freq`."""
    return step % save_freq == 0 or step == total_steps


def write_checkpoint(output_dir: Path, total_steps: int, step: int, write: Callable[[Path], None]) -> Path:
    """Let `write` fill a temporary folder, then move it to `checkpoints/<step>` and point `last` at it."""
    target = checkpoint_dir(output_dir, total_steps, step)
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    write(partial)
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
    link_checkpoint(target, LAST_CHECKPOINT_LINK)
    return target


def link_checkpoint(checkpoint: Path, name: str) -> None:
    """Point `checkpoints/<name>` at a checkpoint beside it; a reader finds the old one or the new one."""
    if checkpoint.with_name(name).resolve() == checkpoint.resolve():
        return
    partial = checkpoint.with_name(f".{name}.partial")
    partial.unlink(missing_ok=True)
    partial.symlink_to(checkpoint.name)
    partial.replace(checkpoint.with_name(name))


def weights_digest(state: Mapping[str, Tensor]) -> str:
    """Return a short digest of a model's weights, by name, equal only for equal weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(state.items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def checkpoint_digest(path: str | Path, parts: bool = True) -> str:
    """Return a short digest of the files that a checkpoint's model is loaded from.

    Unlike the name it changes where another model was trained in the same folder.

    Args:
        path: the checkpoint.
        parts: whether models on this machine that it is made of count too: what an adapter was trained on,
            the world model of a planner.
    """
    folder, digest = local_model_folder(path, MODEL_FILES), hashlib.sha256()
    for file in sorted(each for pattern in MODEL_FILES for each in folder.glob(pattern)):
        digest.update(f"{file.name} {file_digest(file)}".encode())
    for part in named_checkpoints(folder) if parts else ():
        digest.update(checkpoint_digest(part).encode())
    return digest.hexdigest()[:12]


def file_digest(path: Path) -> str:
    """Return a short digest of a file."""
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()[:12]


def named_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints on this machine that a checkpoint's settings name."""
    settings = [json.loads(path.read_text()) for name in SETTINGS if (path := folder / name).is_file()]
    named = [model_folder(each[key]) for each in settings for key in PARTS if each.get(key)]
    return [part for part in named if part.is_dir() and part != folder]


def read_weights(checkpoint: Path, folder: str = PRETRAINED_MODEL_DIR) -> dict[str, Any]:
    """Load the tensors of a checkpoint's model or its adapters, or of another of its folders.

    Raises:
        ValueError: the file is truncated or missing.
    """
    adapters = checkpoint / folder / ADAPTERS_FILE
    path = adapters if adapters.is_file() else checkpoint / folder / SAFETENSORS_SINGLE_FILE
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"{path}: cannot be read ({error}); remove {checkpoint} to continue from the one before"
        ) from error


def step_folders(output_dir: Path) -> list[Path]:
    """List the checkpoints `checkpoints/<step>` of a training in the order of their steps."""
    found = (path for path in (output_dir / CHECKPOINTS_DIR).glob("*") if path.name.isdigit())
    return sorted(found, key=lambda path: int(path.name))


def newest_checkpoint(output_dir: Path) -> Path | None:
    """Return the checkpoint of the highest step, None without one: `write_checkpoint` leaves whole ones."""
    return next(reversed(step_folders(output_dir)), None)


def link_latest(output_dir: Path) -> None:
    """Point `last` at the latest checkpoint, if there is one: a kill may have come between the two."""
    if checkpoint := newest_checkpoint(output_dir):
        link_checkpoint(checkpoint, LAST_CHECKPOINT_LINK)


def require_resumable(output_dir: Path) -> None:
    """Raise FieldError if `resume` is asked for and there is no checkpoint to go on from."""
    if newest_checkpoint(output_dir) is None:
        raise FieldError(
            "resume",
            True,
            f"there is no checkpoint in {output_dir} to go on from",
            "leave `resume` out to begin",
        )
