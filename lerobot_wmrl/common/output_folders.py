"""Output folders: each belongs to the settings of one run, which the same command may continue."""

import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout
from lerobot.utils.utils import flatten_dict

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import foreign_files, write_json

RUN_CONFIG_FILE: Final = "train_config.json"
"""The settings of a run, in its folder."""

CONTENT_FILE: Final = "content.json"
"""Digests of what the settings name."""

LOCK: Final = ".lock"
"""The file that a command locks while it writes the folder."""


@dataclass(frozen=True)
class Claim:
    """What marks an output folder as one run's, so that the same command continues there and no other does.

    Args:
        output_dir: the folder.
        settings: of the run, as JSON.
        free: settings that may differ between the first call and its continuation. So may `output_dir`: a run
            may be moved, but not one of stages, which name its folder.
        content: digests of what settings name, which may be made anew under the same name.
        marker: file of the settings.
    """

    output_dir: Path
    settings: Mapping[str, Any]
    free: Collection[str] = ()
    content: Mapping[str, str] = field(default_factory=dict)
    marker: str = RUN_CONFIG_FILE

    def check(self) -> None:
        """Raise FieldError unless the folder is new, empty or this run's; leave it as it is."""
        if self.output_dir.exists() and not self.output_dir.is_dir():
            raise FieldError("output_dir", self.output_dir, "is a file", "choose a new folder")
        if not self._stored.is_file():
            require_empty(self.output_dir, self.marker, LOCK, CONTENT_FILE)
            return
        free = {"output_dir", *self.free} if self.marker == RUN_CONFIG_FILE else self.free
        require_same(self.output_dir, json.loads(self._stored.read_text()), self.settings, free)
        if self._stored_content.is_file():
            stored = json.loads(self._stored_content.read_text())
            require_same_content(self.output_dir, stored, self.content)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Mark a new folder as this run's, or recognise it, and hold it against other commands.

        Raises:
            FieldError: it holds something else, or another command writes there.
        """
        self.check()
        self.output_dir.mkdir(parents=True, exist_ok=True)
        with hold_lock(self.output_dir, self.output_dir / LOCK):
            self.check()  # another command may have begun there meanwhile
            if not self._stored.is_file():
                if self.content:
                    write_json(self._stored_content, dict(self.content))
                write_json(self._stored, dict(self.settings))
            yield

    @property
    def _stored(self) -> Path:
        return self.output_dir / self.marker

    @property
    def _stored_content(self) -> Path:
        return self.output_dir / CONTENT_FILE


def require_empty(output_dir: Path, *allowed: str) -> None:
    """Raise FieldError for a folder that holds any files but those `allowed`."""
    if foreign_files(output_dir, *allowed):
        raise FieldError("output_dir", output_dir, "holds something else", "choose a new folder")


def require_same_content(output_dir: Path, stored: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Raise FieldError where a name stands for something else than when the folder was begun."""
    if changed := [name for name in stored.keys() & given.keys() if stored[name] != given[name]]:
        raise FieldError(
            "output_dir",
            output_dir,
            f"was begun with another content of {', '.join(sorted(changed))}, under the same name",
            "choose another folder, or restore what was there to continue (of a dataset on the hub, give the "
            "commit that was downloaded then as its `revision`)",
        )


def require_same(
    output_dir: Path, stored: Mapping[str, Any], given: Mapping[str, Any], free: Collection[str] = ()
) -> None:
    """Raise FieldError for settings that differ from those that the folder was begun with."""
    if differing := different_settings(stored, given, free):
        raise FieldError(
            "output_dir",
            output_dir,
            f"was begun with other settings ({'; '.join(differing)})",
            "choose another folder, or repeat the first settings to continue",
        )


@contextmanager
def hold_lock(output_dir: Path, lock: Path, seconds: float = 0) -> Iterator[None]:
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
