"""The instruction as condition tokens (eq. 1, c = i), by a T5 encoder: trained along, or frozen."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from transformers import ByT5Tokenizer, T5Config, T5EncoderModel

from lerobot_wmrl.world_models.frozen_t5 import FrozenT5
from lerobot_wmrl.world_models.instructions import tokenize


class TextEncoder(nn.Module):
    """Base of both. The episodes of a batch share few instructions, so each is encoded once."""

    tokenizer: Any

    def forward(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        """→ condition (B, 1, M, D) and its mask (B, 1, 1, 1, M), True where there is a token."""
        row_of = {text: row for row, text in enumerate(dict.fromkeys(instructions))}
        condition, mask = self.encode(list(row_of))
        rows = torch.tensor([row_of[text] for text in instructions], device=mask.device)
        return condition[rows][:, None], mask[rows][:, None, None, None]

    def encode(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Different instructions → condition tokens (U, M, D) and their mask (U, M)."""
        raise NotImplementedError

    def check(self, instructions: Iterable[str]) -> None:
        """ValueError names an instruction that cannot be encoded."""
        tokenize(self.tokenizer, list(instructions))

    def save(self, folder: Path) -> None:
        """Write to `folder` what a checkpoint needs beside the parameters."""


class ByteTextEncoder(TextEncoder):
    """A small T5 encoder over ByT5's bytes (Xue et al. 2022), trained along: nothing to download."""

    def __init__(self, width: int, text_width: int = 64, layers: int = 2) -> None:
        super().__init__()
        self.tokenizer = ByT5Tokenizer()
        config = T5Config(
            vocab_size=len(self.tokenizer), d_model=text_width, d_kv=text_width // 4, d_ff=4 * text_width,
            num_layers=layers, num_heads=4, dropout_rate=0.0,
        )  # fmt: skip
        self.encoder = T5EncoderModel(config)
        self.project = nn.Linear(text_width, width)

    def encode(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        batch = tokenize(self.tokenizer, instructions).to(self.project.weight.device)
        return self.project(self.encoder(**batch).last_hidden_state), batch["attention_mask"].bool()


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
        """The frozen T5 itself: a published checkpoint must load where its source is out of reach."""
        self.t5.save(folder)


def make_text_encoder(width: int, t5: FrozenT5 | None) -> TextEncoder:
    """The projection of a frozen T5 if there is one, else the small encoder that is trained along."""
    return ByteTextEncoder(width) if t5 is None else FrozenTextEncoder(width, t5)
