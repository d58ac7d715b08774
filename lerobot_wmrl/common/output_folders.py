"""Output folders: each belongs to the settings of one run, which the same command may continue."""

import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout
from lerobot.utils.utils import flatten_dict

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import foreign_files, write_json

CONFIG_FILE: Final = "train_config.json"
"""The settings of a run, in its folder."""


def claim_output_dir(output_dir: Path, config: Mapping[str, Any], free: Collection[str] = ()) -> None:
    """Mark a new folder as this run's, or recognise it. Raises FieldError if it holds something else."""
    require_free(output_dir, config, free)
    if not (output_dir / CONFIG_FILE).is_file():
        write_json(output_dir / CONFIG_FILE, dict(config))


def require_free(output_dir: Path, config: Mapping[str, Any], free: Collection[str] = ()) -> None:
    """Raise FieldError unless the folder is new, empty or this run's; leave it as it is.

    `output_dir` (a run may be moved) and the settings called `free` may differ between the first call and its
    continuation.
    """
    marker = output_dir / CONFIG_FILE
    if output_dir.exists() and not output_dir.is_dir():
        raise FieldError("output_dir", output_dir, "is a file", "choose a new folder")
    if marker.is_file():
        require_same(output_dir, json.loads(marker.read_text()), config, {"output_dir", *free})
    else:
        require_empty(output_dir, CONFIG_FILE)


def require_empty(output_dir: Path, *own: str) -> None:
    """Raise FieldError for a folder that holds anything but the files called `own`."""
    if foreign_files(output_dir, *own):
        raise FieldError("output_dir", output_dir, "holds something else", "choose a new folder")


def require_same(
    output_dir: Path, stored: Mapping[str, Any], given: Mapping[str, Any], free: Collection[str] = ()
) -> None:
    """Raise FieldError for settings that differ from those that the folder was begun with."""
    if differing := different_settings(stored, given, free):
        raise FieldError(
            "output_dir", output_dir, f"was begun with other settings ({'; '.join(differing)})",
            "choose another folder, or repeat the first settings to continue",
        )  # fmt: skip


@contextmanager
def locked(output_dir: Path, lock: Path, seconds: float = 0) -> Iterator[None]:
    """Hold a lock file, which is made where it is missing, against others who write the folder.

    Args:
        output_dir: the folder.
        lock: the lock file, which holds nothing.
        seconds: how long to wait for another one.

    Raises:
        FieldError: somebody else still holds it then.
    """
    held = FileLock(lock, timeout=seconds)
    try:
        held.acquire()
    except Timeout:
        raise FieldError(
            "output_dir", output_dir, "another command writes there", "wait for it, or choose another folder"
        ) from None
    try:
        yield
    finally:
        held.release()


def different_settings(
    stored: Mapping[str, Any], given: Mapping[str, Any], free: Collection[str]
) -> list[str]:
    """Return `name 'stored' → 'given'` of every setting that differs, unless it or its group is `free`.

    A setting that one of the two lacks, being of another version, is off there: None, 0 or empty.
    """
    before, now = (flatten_dict(dict(settings), sep=".") for settings in (stored, given))
    shared = before.keys() & now.keys()
    return [
        f"{name} {before.get(name)!r} → {now.get(name)!r}"
        for name in {**before, **now}
        if (before[name] != now[name] if name in shared else before.get(name) or now.get(name))
        and not any(name == each or name.startswith(f"{each}.") for each in free)
    ]
