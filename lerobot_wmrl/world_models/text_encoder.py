"""The instruction as condition tokens: a small T5 encoder over ByT5 bytes, trained along, no download."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from transformers import ByT5Tokenizer, T5Config, T5EncoderModel


class ByteTextEncoder(nn.Module):
    """Instructions to (B, 1, M, D) condition tokens; M is the longest instruction's bytes."""

    def __init__(self, width: int, text_width: int = 64, layers: int = 2) -> None:
        super().__init__()
        self.tokenizer = ByT5Tokenizer()
        config = T5Config(
            vocab_size=len(self.tokenizer), d_model=text_width, d_kv=text_width // 4, d_ff=4 * text_width,
            num_layers=layers, num_heads=4, dropout_rate=0.0,
        )  # fmt: skip
        self.encoder = T5EncoderModel(config)
        self.project = nn.Linear(text_width, width)

    def forward(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        """→ condition (B, 1, M, D) and its mask (B, 1, 1, 1, M), True where there is a byte."""
        batch = self.tokenizer(list(instructions), padding=True, return_tensors="pt").to(
            self.project.weight.device
        )
        hidden = self.encoder(
            input_ids=batch["input_ids"], attention_mask=batch["attention_mask"]
        ).last_hidden_state
        return self.project(hidden)[:, None], batch["attention_mask"].to(torch.bool)[:, None, None, None]
