"""What to say to somebody who wrote a name that does not exist."""

import difflib
from collections.abc import Sequence


def suggestion(name: str, known: Sequence[str], prefix: str = "") -> str:
    """The nearest of the known names, with `prefix` before it; all of them if none is near."""
    near = difflib.get_close_matches(name, known, 1)
    return f"did you mean {prefix}{near[0]}?" if near else f"choose from {', '.join(known)}"
