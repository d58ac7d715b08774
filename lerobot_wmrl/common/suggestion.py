"""What to say to somebody who wrote a name that does not exist."""

import difflib
from collections.abc import Sequence


def nearest(name: str, known: Sequence[str]) -> str | None:
    """The known name that is most like it, if one is near."""
    return next(iter(difflib.get_close_matches(name, known, 1)), None)


def suggestion(name: str, known: Sequence[str], prefix: str = "") -> str:
    """The nearest of the known names, with `prefix` before it; all of them if none is near."""
    near = nearest(name, known)
    return f"did you mean {prefix}{near}?" if near else f"choose from {', '.join(known)}"
