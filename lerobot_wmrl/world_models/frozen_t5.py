"""A pretrained T5 encoder (Raffel et al. 2020) that nothing trains: T5, flan-T5, ByT5, mT5 or umT5."""

from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from torch import Tensor
from transformers import AutoConfig, AutoModelForTextEncoding, AutoTokenizer

from lerobot_wmrl.world_models.instructions import tokenize

T5_TYPES: Final = ("t5", "mt5", "umt5")
"""`model_type`s of the family. ByT5 and flan-T5 are of type t5."""

VOCABULARY_PADDING = 128
"""Encoders' vocabularies are rounded up to multiples of it. Tokenizers that differ by more are others; of a
folder without one, transformers makes an empty one up."""

CACHED_INSTRUCTIONS = 4096

CHECKPOINT_FOLDER: Final = "text_encoder"
"""Where a checkpoint carries it, as diffusers' pipelines do."""

UNREADABLE: Final = (OSError, ValueError, ImportError, SafetensorError)
"""What transformers raises of models that are not there, broken, or need another package."""


def first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0]


class FrozenT5:
    """Encoder and tokenizer; the embedding of each instruction is computed once.

    No `nn.Module`: it is no parameter of the model that asks it, so no optimiser, `state_dict`, training mode
    or gradient synchronisation meets it.
    """

    def __init__(self, model: Any, tokenizer: Any) -> None:
        self.model = model.requires_grad_(False).eval()
        self.tokenizer = tokenizer
        self.embed = lru_cache(CACHED_INSTRUCTIONS)(self._embed)

    @classmethod
    def load(cls, source: str) -> "FrozenT5":
        """The T5 that `--model.text_encoder` names, a hub id or a folder. ValueError if there is none."""
        try:
            return cls.read(source)
        except UNREADABLE as error:
            raise ValueError(
                f"--model.text_encoder={source}: no T5 encoder with its tokenizer there "
                f"({first_line(error)}); give the id of one on the hub, as google/flan-t5-small, or a folder "
                "that holds one. Without a network, download it first and give its folder"
            ) from error

    @classmethod
    def load_carried(cls, checkpoint: str | Path, revision: str | None = None) -> "FrozenT5":
        """The T5 that a world model's checkpoint, a folder or a hub id, carries. ValueError if it is lost."""
        try:
            return cls.read(checkpoint, subfolder=CHECKPOINT_FOLDER, revision=revision)
        except UNREADABLE as error:
            raise ValueError(
                f"{checkpoint}: the text encoder in its folder {CHECKPOINT_FOLDER} cannot be read "
                f"({first_line(error)}); copy the checkpoint again, with its folders"
            ) from error

    @classmethod
    def read(cls, source: str | Path, **options: Any) -> "FrozenT5":
        """`transformers`' loading, for the T5 family only. Raises any of `UNREADABLE`."""
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
        """→ the last hidden states (M, width) of one instruction's tokens, float32."""
        batch = tokenize(self.tokenizer, [instruction]).to(device)
        return self.model.to(device)(**batch).last_hidden_state[0].float()
