"""Instructions of a batch, few of which are different."""

from collections.abc import Sequence


def distinct(instructions: Sequence[str]) -> tuple[list[str], list[int]]:
    """Return the U different instructions in the order in which they occur, and for each of the B given ones
    the row where it stands among them."""
    row_of = {text: row for row, text in enumerate(dict.fromkeys(instructions))}
    return list(row_of), [row_of[text] for text in instructions]
