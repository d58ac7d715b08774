"""Errors that know the field they are about; the command that was called knows its flag."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Final


class FieldError(ValueError):
    """Report a setting that cannot be, by the name of its field.

    Code below the commands does not know how its settings were given, so it names the field as its own
    configuration does (`patch`, `reward.form`), and other fields in `remedy` in backquotes. The command line
    says both as the flags that were typed (`--env.reward.form`).

    Args:
        field: dotted name of the field, relative to the configuration that raises.
        value: what it was set to.
        problem: why that cannot be.
        remedy: what to set instead.
    """

    def __init__(self, field: str, value: object, problem: str, remedy: str = "") -> None:
        super().__init__(field, value, problem, remedy)
        self.field, self.value, self.problem, self.remedy = field, value, problem, remedy

    def __str__(self) -> str:
        message = f"{self.field}={self.value}: {self.problem}"
        return f"{message}; {self.remedy}" if self.remedy else message


STOPPED: Final = 3
"""Exit status of a command that ends with `Stopped`; after other errors it is 1."""


class Stopped(ValueError):
    """A command ends before its work is done, by a rule of its own; what it has made so far is whole."""


class TrainingStopped(Stopped):
    """Reinforcement learning or distillation cannot go on; the last checkpoint is good.

    Args:
        message: why, and what to change.
        before_update: whether the policy is still that of the iteration before, in every process.
    """

    def __init__(self, message: str, before_update: bool = False) -> None:
        super().__init__(message)
        self.before_update = before_update


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its kind if it has none."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def require_at_least(settings: object, least: float, *fields: str) -> None:
    """Raise FieldError for the first of the `fields` of `settings` that is below `least`."""
    for field in fields:
        if getattr(settings, field) < least:
            raise FieldError(field, getattr(settings, field), f"must be at least {least}")


def require_positive(settings: object, *fields: str) -> None:
    """Raise FieldError for the first of the `fields` of `settings` that is not above 0."""
    for field in fields:
        if getattr(settings, field) <= 0:
            raise FieldError(field, getattr(settings, field), "must be above 0")


def require_share(settings: object, *fields: str) -> None:
    """Raise FieldError for the first of the `fields` of `settings` that is not within 0 and 1."""
    for field in fields:
        if not 0 <= getattr(settings, field) <= 1:
            raise FieldError(field, getattr(settings, field), "must be between 0 and 1")


def require_probability(settings: object, *fields: str) -> None:
    """Raise FieldError for the first of the `fields` of `settings` that is not between 0 and 1, or is one."""
    for field in fields:
        if not 0 < getattr(settings, field) < 1:
            raise FieldError(field, getattr(settings, field), "must be above 0 and below 1")


def require_choice(settings: object, field: str, choices: Iterable[object]) -> None:
    """Raise FieldError unless the field is one of the choices."""
    value, known = getattr(settings, field), list(choices)
    if value not in known:
        raise FieldError(field, value, f"choose one of {', '.join(map(str, known))}")


@contextmanager
def within(group: str) -> Iterator[None]:
    """Put `group.` before the field of a FieldError that leaves the block."""
    try:
        yield
    except FieldError as error:
        raise FieldError(f"{group}.{error.field}", error.value, error.problem, error.remedy) from None


@contextmanager
def renamed(field: str, name: str) -> Iterator[None]:
    """Let a FieldError about `field`, or about a field of the group `field`, be about `name` instead.

    What its text names in backquotes is renamed too.
    """

    def moved(text: str) -> str:
        return re.sub(rf"`{re.escape(field)}(?=[`.=])", f"`{name}", text)

    try:
        yield
    except FieldError as error:
        if error.field != field and not error.field.startswith(f"{field}."):
            raise
        new = f"{name}{error.field.removeprefix(field)}"
        raise FieldError(new, error.value, moved(error.problem), moved(error.remedy)) from error


def suggestion(name: str, known: Sequence[str], prefix: str = "") -> str:
    """Return the known name nearest to a wrong one, with `prefix` before it; all of them if none is near."""
    near = get_close_matches(name, known, 1)
    return f"did you mean {prefix}{near[0]}?" if near else f"choose from {', '.join(known)}"
