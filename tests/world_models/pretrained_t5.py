"""Small T5 encoders with random weights, written to folders as pretrained ones are."""

from pathlib import Path
from typing import Any

import torch
from transformers import (
    ByT5Tokenizer,
    MT5Config,
    MT5EncoderModel,
    T5Config,
    T5EncoderModel,
    T5Tokenizer,
    UMT5Config,
    UMT5EncoderModel,
)

SIZES: dict[str, Any] = {"d_model": 24, "d_kv": 8, "d_ff": 32, "num_layers": 1, "num_heads": 2}
WORDS = ("push", "pull", "the", "red", "green", "square", "forward", "back", "it")


def word_tokenizer() -> T5Tokenizer:
    """T5's kind of tokenizer over a few words, with T5's maximum of 512 tokens."""
    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), *((f"▁{word}", -1.0) for word in WORDS)]
    return T5Tokenizer(vocab=pieces, extra_ids=0, model_max_length=512)


FAMILY: dict[str, tuple[Any, Any, Any]] = {
    "t5": (T5EncoderModel, T5Config, word_tokenizer),
    "byt5": (T5EncoderModel, T5Config, ByT5Tokenizer),
    "mt5": (MT5EncoderModel, MT5Config, word_tokenizer),
    "umt5": (UMT5EncoderModel, UMT5Config, word_tokenizer),
}


def save_t5(folder: Path, kind: str = "t5") -> Path:
    """A small encoder of this kind with its tokenizer in `folder`. Its dropout is T5's own, 0.1."""
    torch.manual_seed(1)
    model, config, tokenizer = FAMILY[kind]
    tokens = tokenizer()
    model(config(vocab_size=len(tokens), **SIZES)).save_pretrained(folder)
    tokens.save_pretrained(folder)
    return folder
