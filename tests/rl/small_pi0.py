"""LeRobot's π0 in small: 13 million parameters, nearly all of them for its vocabulary."""

from pathlib import Path
from typing import Any

import pytest
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import GemmaConfig, PI0Policy
from transformers import GemmaConfig as LanguageConfig
from transformers import PaliGemmaConfig, SiglipVisionConfig

from tests.hub_server import Hub, Repo
from tests.rl.byte_tokenizer import byte_tokenizer

TOKENIZER = "google/paligemma-3b-pt-224"

SIDE = 28
"""Pixels on each side of what the vision encoder sees: four patches."""


def shrink_pi0(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every π0 small: LeRobot knows two sizes of it, of billions of parameters."""
    size = GemmaConfig(width=16, depth=2, mlp_dim=16, num_heads=8, num_kv_heads=1, head_dim=2)
    vision = SiglipVisionConfig(hidden_size=16, num_hidden_layers=1, num_attention_heads=2)

    def make_paligemma() -> PaliGemmaConfig:
        return PaliGemmaConfig(vision_config=vision, text_config=LanguageConfig())

    monkeypatch.setattr(modeling_pi0, "get_gemma_config", lambda variant: size)
    whole = modeling_pi0.PaliGemmaForConditionalGenerationWithPiGemma

    def make_whole(config: PaliGemmaConfig) -> Any:
        config.vision_config.projection_dim = size.width  # LeRobot sets that of the larger language model
        return whole(config=config)

    monkeypatch.setattr(modeling_pi0, "PaliGemmaForConditionalGenerationWithPiGemma", make_whole)
    known = {"paligemma": make_paligemma, "gemma": LanguageConfig}
    monkeypatch.setattr(modeling_pi0, "CONFIG_MAPPING", known)


def publish_tokenizer(hub: Hub, folder: Path) -> None:
    """Put a tokenizer of bytes where π0 looks for its own."""
    byte_tokenizer().save_pretrained(folder)
    hub.repos["models", TOKENIZER] = repo = Repo(private=False)
    repo.commit({path.name: path.read_bytes() for path in folder.iterdir()})


def small_pi0(**features: Any) -> PI0Policy:
    """Return an untrained policy, where `shrink_pi0` has made them small."""
    return PI0Policy(
        PI0Config(
            image_resolution=(SIDE, SIDE), chunk_size=8, n_action_steps=4, num_inference_steps=2, **features
        )
    )
