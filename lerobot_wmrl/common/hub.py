"""The Hugging Face hub: who is logged in, what its errors mean, and its cache on disk."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import httpx
from huggingface_hub import HfApi, get_token
from huggingface_hub.errors import HfHubHTTPError, HFValidationError

from lerobot_wmrl.common.errors import FieldError

PUSH: Final = "push_to_hub"

DENIED: Final = (401, 403, 404)
"""HTTP statuses for a token that may not write. The hub answers 404 for what the token may not see."""


def cached_repo(folder: Path) -> str | None:
    """Return the name of the repository in the hub's cache (`datasets--user--name`) of which a folder is a
    revision, None if it is none."""
    name = folder.parents[1].name if folder.parent.name == "snapshots" else ""
    return name if name.startswith(("datasets--", "models--")) else None


def published_name(path: str | Path) -> tuple[str, str | None] | None:
    """Return the name of a model on the hub, and its revision if it is one in the hub's cache; None of a
    folder that nobody else has."""
    folder = Path(path)
    if not folder.exists():
        return str(path), None
    kind, _, name = (cached_repo(folder) or "").partition("--")
    return (name.replace("--", "/", 1), folder.name) if kind == "models" else None


def check_login() -> None:
    """Raise FieldError about `push_to_hub` if nobody is logged in to the hub."""
    if get_token() is None:
        raise FieldError(PUSH, "true", "nobody is logged in to the hub here", "run hf auth login")


@contextmanager
def publishing(name: str, remedy: str) -> Iterator[None]:
    """Turn the hub's errors that leave the block into a FieldError about `push_to_hub`.

    Args:
        name: what is published, by its name on the hub.
        remedy: what to do then, and what is not lost.
    """
    try:
        yield
    except (httpx.HTTPError, OSError, RuntimeError, HFValidationError) as error:
        raise FieldError(PUSH, "true", f"{name} is not published: {failure_reason(error)}", remedy) from error


def create_repo(api: HfApi, name: str, private: bool | None, kind: str | None = None) -> str:
    """Create a repository unless it exists, and return its full name.

    Args:
        api: the client.
        name: its name on the hub.
        private: whether it must be private. Otherwise a new one gets the visibility that its organisation
            gives new ones.
        kind: of repository, `dataset` or a model's by default.

    Raises:
        FieldError: it is public, and must be private.
    """
    name = api.create_repo(name, repo_type=kind, private=private or None, exist_ok=True).repo_id
    if private and not api.repo_info(name, repo_type=kind).private:
        raise FieldError(
            "private",
            "true",
            f"{name} is public on the hub already",
            "make it private there, or choose another `repo_id`",
        )
    return name


def failure_reason(error: Exception) -> str:
    """Return why publishing failed, and what helps."""
    if isinstance(error, (httpx.TransportError, ConnectionError)):
        return f"the hub cannot be reached ({error})"
    if not isinstance(error, HfHubHTTPError):
        return f"the upload failed ({error})"
    status = error.response.status_code
    refusal = f"the hub refuses ({status}, {error.server_message or error.response.reason_phrase})"
    if status in DENIED:
        return f"{refusal}; log in with a token that may write there: `hf auth login`"
    return refusal
