"""Checks of what a page sends, and of where it is served."""

from typing import Any, Final

import numpy as np

from lerobot_wmrl.common.errors import FieldError

LAST_PORT: Final = 65535


def whole_number(name: str, value: Any, most: int) -> int:
    """Return the value of a field. FieldError unless it is a whole number from 0 to `most`."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
        raise FieldError(name, value, f"must be a whole number from 0 to {most}")
    return value


def is_numbers(values: Any) -> bool:
    """Return whether this is a list of finite numbers."""
    return isinstance(values, list) and all(
        isinstance(each, int | float) and not isinstance(each, bool) and np.isfinite(each) for each in values
    )


def instruction(value: Any) -> str:
    """Return an instruction. FieldError unless it is a text of at most 500 characters."""
    if not isinstance(value, str) or len(value) > 500:
        raise FieldError("instruction", value, "must be a text of at most 500 characters")
    return value
