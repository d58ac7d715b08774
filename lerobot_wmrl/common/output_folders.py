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


CONTENT_FILE: Final = "content.json"
"""Digests of what the settings name."""

LOCK: Final = ".lock"
"""The file that a command locks while it writes the folder."""


@contextmanager
def claimed(
    output_dir: Path, settings: Mapping[str, Any], free: Collection[str] = (), marker: str = CONFIG_FILE,
    content: Mapping[str, str] | None = None,
) -> Iterator[None]:  # fmt: skip
    """Mark a new folder as this run's, or recognise it, and hold it against other commands.

    Args:
        output_dir: the folder.
        settings: of the run, as JSON.
        free: settings that may differ between the first call and its continuation.
        marker: file of the settings.
        content: digests of what settings name, which may be made anew under the same name.

    Raises:
        FieldError: it holds something else, or another command writes there.
    """
    require_free(output_dir, settings, free, marker, content)
    output_dir.mkdir(parents=True, exist_ok=True)
    with locked(output_dir, output_dir / LOCK):
        # another command may have begun there meanwhile
        require_free(output_dir, settings, free, marker, content)
        if not (output_dir / marker).is_file():
            if content:
                write_json(output_dir / CONTENT_FILE, dict(content))
            write_json(output_dir / marker, dict(settings))
        yield


def require_free(
    output_dir: Path, settings: Mapping[str, Any], free: Collection[str] = (), marker: str = CONFIG_FILE,
    content: Mapping[str, str] | None = None,
) -> None:  # fmt: skip
    """Raise FieldError unless the folder is new, empty or this run's; leave it as it is.

    The settings called `free` may differ between the first call and its continuation. So may `output_dir`: a
    run may be moved, but not one of stages, which name its folder.
    """
    stored = output_dir / marker
    if output_dir.exists() and not output_dir.is_dir():
        raise FieldError("output_dir", output_dir, "is a file", "choose a new folder")
    if stored.is_file():
        free = {"output_dir", *free} if marker == CONFIG_FILE else free
        require_same(output_dir, json.loads(stored.read_text()), settings, free)
        if content and (kept := output_dir / CONTENT_FILE).is_file():
            require_same_content(output_dir, json.loads(kept.read_text()), content)
    else:
        require_empty(output_dir, marker, LOCK, CONTENT_FILE)


def require_empty(output_dir: Path, *own: str) -> None:
    """Raise FieldError for a folder that holds anything but the files called `own`."""
    if foreign_files(output_dir, *own):
        raise FieldError("output_dir", output_dir, "holds something else", "choose a new folder")


def require_same_content(output_dir: Path, stored: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Raise FieldError where a name stands for something else than when the folder was begun."""
    if changed := [name for name in stored.keys() & given.keys() if stored[name] != given[name]]:
        raise FieldError(
            "output_dir", output_dir,
            f"was begun with another content of {', '.join(sorted(changed))}, under the same name",
            "choose another folder, or restore what was there to continue",
        )  # fmt: skip


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
