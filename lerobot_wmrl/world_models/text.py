"""The instruction as condition tokens (eq. 1, c = i), by a T5 encoder: trained along, or frozen."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from transformers import (
    AutoConfig,
    AutoModelForTextEncoding,
    AutoTokenizer,
    ByT5Tokenizer,
    T5Config,
    T5EncoderModel,
)
from transformers.tokenization_utils_base import VERY_LARGE_INTEGER

from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.instructions import distinct
from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.world_models.condition import Condition

MAX_TOKENS: Final = 512
"""Limit where a tokenizer states none of its own: the length T5 was trained with (Raffel et al. 2020)."""

QUOTED_CHARACTERS = 40
"""Characters of an instruction that an error repeats."""

T5_TYPES: Final = ("t5", "mt5", "umt5")
"""`model_type`s of the family. ByT5 and flan-T5 are of type t5."""

VOCABULARY_PADDING = 128
"""Tokens by which the vocabularies of encoder and tokenizer may differ, as encoders round up to multiples of
this. A larger difference means a tokenizer of another model, or the empty one that transformers makes up for
a folder without any."""

CACHED_INSTRUCTIONS = 4096

CHECKPOINT_FOLDER: Final = "text_encoder"
"""Folder of a checkpoint that holds the frozen T5, named as in diffusers' pipelines."""

UNREADABLE: Final = (OSError, ValueError, ImportError, SafetensorError)
"""Errors of transformers about models that are missing, broken, or need another package."""


def tokenize(tokenizer: Any, instructions: Sequence[str]) -> Any:
    """Return a Hugging Face tokenizer's `input_ids` and `attention_mask` (B, M), padded to the longest.

    Raises:
        ValueError: an instruction is empty, or longer than the tokenizer's maximum: cutting it silently
            could cut off what it asks for.
    """
    if not all(text.strip() for text in instructions):
        raise ValueError(
            "task='': an instruction is empty, and the model has to know what is asked for; give every "
            "episode a task"
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
    """Return the tokenizer's own maximum, `MAX_TOKENS` if it states none."""
    limit = tokenizer.model_max_length
    return MAX_TOKENS if limit >= VERY_LARGE_INTEGER else int(limit)


def instruction_problem(instructions: Iterable[str]) -> str:
    """Return what keeps `ByteTextEncoder` from reading one of the instructions; nothing if it reads all."""
    try:
        tokenize(ByT5Tokenizer(), list(dict.fromkeys(instructions)))
    except ValueError as error:
        return str(error)
    return ""


def check_one_each(instructions: Sequence[str], batch: int) -> None:
    """Raise ValueError unless there is one instruction for each of `batch` episodes."""
    if isinstance(instructions, str) or len(instructions) != batch:
        received = "a single string" if isinstance(instructions, str) else f"{len(instructions)} instructions"
        raise ValueError(f"task: {received} for {batch} episodes; give a list with one instruction for each")


class FrozenT5:
    """A pretrained T5 encoder (Raffel et al. 2020) and its tokenizer: T5, flan-T5, ByT5, mT5 or umT5.

    The embedding of each instruction is computed once. It is not an `nn.Module`: the world model's
    optimiser, `state_dict`, training mode and gradient synchronisation leave it alone.
    """

    def __init__(self, model: Any, tokenizer: Any) -> None:
        self.model = model.requires_grad_(False).eval()
        self.tokenizer = tokenizer
        self.embed = lru_cache(CACHED_INSTRUCTIONS)(self._embed)

    @classmethod
    def load(cls, source: str) -> "FrozenT5":
        """Load a T5 from a hub id or a folder. FieldError if there is none."""
        try:
            return cls.read(source)
        except UNREADABLE as error:
            raise FieldError(
                "text_encoder",
                source,
                f"no T5 encoder with its tokenizer there ({first_line(error)})",
                "give the id of one on the hub, as google/flan-t5-small, or a folder that holds one. Without "
                "a network, download it first and give its folder",
            ) from error

    @classmethod
    def load_carried(cls, checkpoint: str | Path, revision: str | None = None) -> "FrozenT5":
        """Load the T5 that the checkpoint of a world model carries. ValueError if it is lost."""
        try:
            return cls.read(checkpoint, subfolder=CHECKPOINT_FOLDER, revision=revision)
        except UNREADABLE as error:
            raise ValueError(
                f"{checkpoint}: the text encoder in its folder {CHECKPOINT_FOLDER} cannot be read "
                f"({first_line(error)}); copy the checkpoint again, with its folders"
            ) from error

    @classmethod
    def read(cls, source: str | Path, **options: Any) -> "FrozenT5":
        """Load with `transformers`, the T5 family only. Raises any of `UNREADABLE`."""
        config = AutoConfig.from_pretrained(source, **options)
        if config.model_type not in T5_TYPES:
            raise ValueError(f"it is of type {config.model_type!r}")
        tokenizer = AutoTokenizer.from_pretrained(source, **options)
        if abs(len(tokenizer) - config.vocab_size) > VOCABULARY_PADDING:
            raise ValueError(f"its tokenizer knows {len(tokenizer)} tokens, the encoder {config.vocab_size}")
        return cls(AutoModelForTextEncoding.from_pretrained(source, **options), tokenizer)

    def save(self, folder: Path) -> None:
        """Write encoder and tokenizer as `load` and transformers read them."""
        self.model.save_pretrained(folder)
        self.tokenizer.save_pretrained(folder)

    @property
    def width(self) -> int:
        return self.model.config.d_model

    @torch.no_grad()
    def _embed(self, instruction: str, device: torch.device) -> Tensor:
        """Return the last hidden states (M, width) of one instruction's tokens in float32."""
        batch = tokenize(self.tokenizer, [instruction]).to(device)
        with compute_in(torch.float32, device):  # as loaded, also for trainings in bfloat16
            return self.model.to(device)(**batch).last_hidden_state[0].float()


class TextEncoder(nn.Module):
    """Base class of text encoders. A batch has few different instructions, so each is encoded once."""

    tokenizer: Any

    def forward(self, instructions: Sequence[str]) -> Condition:
        """Encode B instructions. → tokens (B, 1, M, D), mask (B, 1, 1, 1, M)"""
        different, rows = distinct(instructions)
        condition, mask = self.encode(different)
        return Condition(condition[rows][:, None], mask[rows][:, None, None, None])

    def encode(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Encode different instructions. → condition tokens (U, M, D) and their mask (U, M)"""
        raise NotImplementedError

    def check(self, instructions: Iterable[str]) -> None:
        """Raise ValueError for an instruction that cannot be encoded."""
        tokenize(self.tokenizer, list(instructions))

    def save(self, folder: Path) -> None:
        """Write to `folder` what a checkpoint needs beside the parameters: nothing."""


class ByteTextEncoder(TextEncoder):
    """A small T5 encoder over ByT5's bytes (Xue et al. 2022), trained along: nothing to download."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.tokenizer = ByT5Tokenizer()
        config = T5Config(
            vocab_size=len(self.tokenizer),
            d_model=64,
            d_kv=16,
            d_ff=256,
            num_layers=2,
            num_heads=4,
            dropout_rate=0.0,
        )
        self.encoder = T5EncoderModel(config)
        self.project = nn.Linear(config.d_model, width)

    def encode(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        batch = self.tokens(instructions)
        return self.embed(**batch), batch["attention_mask"].bool()

    def tokens(self, instructions: Sequence[str]) -> Any:
        """Return `input_ids` and `attention_mask` (U, M) of U instructions, on the parameters' device."""
        return tokenize(self.tokenizer, instructions).to(self.project.weight.device)

    def embed(self, input_ids: Tensor, attention_mask: Tensor) -> Tensor:
        """Bytes as ByT5 numbers them (U, M) and where there are any (U, M) → condition tokens (U, M, D)."""
        tokens: Tensor = self.project(self.encoder(input_ids, attention_mask).last_hidden_state)
        return tokens


class FrozenTextEncoder(TextEncoder):
    """A pretrained T5 that stays as it is, and a learned projection of its hidden states.

    The norm gives cross-attention unit variance: a pretrained T5's hidden states have a scale of their own.
    """

    def __init__(self, width: int, t5: FrozenT5) -> None:
        super().__init__()
        self.t5, self.tokenizer = t5, t5.tokenizer
        self.norm = nn.LayerNorm(t5.width)
        self.project = nn.Linear(t5.width, width)

    def encode(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        hidden = [self.t5.embed(text, self.project.weight.device) for text in instructions]
        mask = [torch.ones_like(states[:, 0], dtype=torch.bool) for states in hidden]
        padded = pad_sequence(hidden, batch_first=True)
        return self.project(self.norm(padded)), pad_sequence(mask, batch_first=True)

    def save(self, folder: Path) -> None:
        """Write the frozen T5: a published checkpoint must load where its source is out of reach."""
        self.t5.save(folder)


def make_text_encoder(width: int, t5: FrozenT5 | None) -> TextEncoder:
    """Return the projection of a frozen T5 if there is one, else the small encoder that is trained along."""
    return ByteTextEncoder(width) if t5 is None else FrozenTextEncoder(width, t5)
