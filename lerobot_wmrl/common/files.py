"""Files and folders that are either whole or absent, and what is written into them."""

import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from errno import EACCES, EDQUOT, EFBIG, ENOSPC, EPERM, EROFS
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.errors import FieldError

NOT_WRITABLE = (EACCES, EDQUOT, EFBIG, ENOSPC, EPERM, EROFS)
"""Error numbers of a disk that is full or must not be written."""


def write_text(path: Path, text: str) -> None:
    """Write beside `path`, then rename: a reader or a crash never sees half a file. Makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Give a folder beside `target` to fill, which does not exist yet; rename it when it is whole.

    `target` must be empty or not exist; of a link that holds for what it points to. What a torn call left is
    removed by the next one.
    """
    target = target.resolve()
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.parent.mkdir(parents=True, exist_ok=True)
    yield partial
    partial.replace(target)


def require_new(field: str, target: Path) -> None:
    """Raise FieldError if there is something at `target` already, other than an empty folder."""
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise FieldError(field, target, "there is something already", "choose a new folder")
    require_no_mount(field, target)


def require_no_mount(field: str, target: Path) -> None:
    """Raise FieldError if a disk is mounted at `target`."""
    if target.is_mount():
        raise FieldError(
            field,
            target,
            "a disk is mounted there, and a whole folder cannot take its place",
            "choose a folder in it",
        )


def foreign_files(folder: Path, *allowed: str) -> bool:
    """Return whether a folder holds more than the `allowed` files and what a torn `write_text` left."""
    known = {*allowed, *(f".{name}.partial" for name in allowed)}
    return folder.is_dir() and any(path.name not in known for path in folder.iterdir())


@contextmanager
def writing(flag: str, folder: Path, *, resumes: bool = True) -> Iterator[None]:
    """Raise ValueError with `flag` and the remedy if the disk is full or must not be written.

    resumes: whether the same command continues where it stopped; otherwise it begins again.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NOT_WRITABLE:
            raise
        then = "continues: nothing that was finished is lost" if resumes else "begins again"
        raise ValueError(
            f"--{flag}={folder}: cannot be written ({error}); make room or choose another folder. "
            f"The same command {then}"
        ) from error


def write_json(path: Path, content: Any) -> None:
    """Write `content` as indented JSON, whole or not at all."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format head and rows, one a line."""
    cells = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(str(cell) for cell in row)} |" for row in cells)
