"""A SmolVLA of a few thousand parameters, with a language model and a tokenizer of its own."""

from pathlib import Path
from typing import Any

from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from transformers import (
    SmolVLMConfig,
    SmolVLMImageProcessor,
    SmolVLMProcessor,
    SmolVLMVideoProcessor,
)

from tests.rl.byte_tokenizer import byte_tokenizer

SIDE = 16
"""Pixels on each side of what the vision encoder sees."""


def save_small_smolvlm(folder: Path) -> Path:
    """Save configuration and processor of a SmolVLM, whose tokenizer knows every byte, and nothing longer."""
    special = {
        "fake_image_token": "<fake_token_around_image>",
        "image_token": "<image>",
        "global_image_token": "<global-img>",
        "end_of_utterance_token": "<end_of_utterance>",
    }
    tokenizer = byte_tokenizer(**special)
    SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor()).save_pretrained(folder)
    SmolVLMConfig(
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        pad_token_id=0,
        scale_factor=2,
        vision_config={
            "hidden_size": 16,
            "intermediate_size": 16,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "image_size": SIDE,
            "patch_size": 4,
        },
        text_config={
            "model_type": "llama",
            "hidden_size": 32,
            "intermediate_size": 32,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "num_key_value_heads": 1,
            "head_dim": 16,
            "vocab_size": len(tokenizer),
        },
    ).save_pretrained(folder)
    return folder


def small_smolvla(smolvlm: Path, **features: Any) -> SmolVLAPolicy:
    """Return an untrained policy on the SmolVLM that `save_small_smolvlm` has saved."""
    return SmolVLAPolicy(
        SmolVLAConfig(
            vlm_model_name=str(smolvlm),
            num_vlm_layers=2,
            resize_imgs_with_padding=(SIDE, SIDE),
            chunk_size=8,
            n_action_steps=4,
            num_steps=2,
            **features,
        )
    )
