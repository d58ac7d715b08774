"""Instructions to token ids, with what no text encoder can make sense of named."""

from collections.abc import Sequence
from typing import Any, Final

from transformers.tokenization_utils_base import VERY_LARGE_INTEGER

MAX_TOKENS: Final = 512
"""What T5 was trained with (Raffel et al. 2020); the limit where a tokenizer states none of its own."""

QUOTED_CHARACTERS = 40
"""How much of an instruction an error repeats."""


def tokenize(tokenizer: Any, instructions: Sequence[str]) -> Any:
    """A Hugging Face tokenizer's `input_ids` and `attention_mask` (B, M), padded to the longest.

    Raises:
        ValueError: an instruction is empty, or longer than the tokenizer's maximum: cutting it silently
            could cut off what it asks for.
    """
    if not all(text.strip() for text in instructions):
        raise ValueError(
            "task='': an instruction is empty, and it is what tells the text world model which goal to "
            "imagine; give every episode a task"
        )
    batch = tokenizer(list(instructions), padding=True, return_tensors="pt")
    limit = token_limit(tokenizer)
    for text, length in zip(instructions, batch["attention_mask"].sum(1).tolist(), strict=True):
        if length > limit:
            raise ValueError(
                f"task={text[:QUOTED_CHARACTERS]!r}…: an instruction of {len(text)} characters has {length} "
                f"tokens; the text encoder takes at most {limit}: shorten it"
            )
    return batch


def token_limit(tokenizer: Any) -> int:
    """The tokenizer's own maximum, `MAX_TOKENS` if it states none."""
    own = tokenizer.model_max_length
    return MAX_TOKENS if own >= VERY_LARGE_INTEGER else int(own)


def check_one_each(instructions: Sequence[str], batch: int) -> None:
    """ValueError unless there is one instruction for each of `batch` episodes."""
    if isinstance(instructions, str) or len(instructions) != batch:
        given = "a single string" if isinstance(instructions, str) else f"{len(instructions)} instructions"
        raise ValueError(f"task: {given} for {batch} episodes; give a list with one instruction for each")
