"""OpenVLA's own checkpoint format, written."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from huggingface_hub import save_torch_state_dict
from torch import Tensor

from lerobot_policy_openvla.openvla_checkpoint import (
    CONFIG_FILE,
    ORIGINAL_CONFIG_FILE,
    STATISTICS_FILE,
    SUPPORTED,
    VIT_IDS,
    Files,
)
from lerobot_policy_openvla.sizes import DINO, RELEASED_HEADS, SIGLIP, VIT_FILE, Sizes, ViTSizes
from lerobot_policy_openvla.statistics import NormStats, used_statistics

MAX_SHARD: Final = "5GB"


def write_openvla(
    folder: Path, weights: Mapping[str, Tensor], sizes: Sizes, companions: Files, norm_stats: NormStats
) -> None:
    """A checkpoint that OpenVLA's own code loads, sharded like the release where it is large.

    Args:
        folder: made if it is not there.
        weights: by OpenVLA's names.
        sizes: of the model; needed where no original configuration is among `companions`.
        companions: written as they are, but for the statistics.
        norm_stats: added to those that the checkpoint came with, and put in place of those that differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = dict(companions)
    config = json.loads(files.pop(ORIGINAL_CONFIG_FILE, b"null")) or original_config(sizes)
    stored = files.pop(STATISTICS_FILE, None)
    known = json.loads(stored) if stored else config.get("norm_stats") or {}
    changed = changed_statistics(norm_stats, known)
    config["norm_stats"] = {**(config.get("norm_stats") or {}), **changed}
    if not {sizes.dino.width, sizes.siglip.width} <= RELEASED_HEADS.keys():
        files.setdefault(VIT_FILE, _json(vit_overrides(sizes)))
    files |= {CONFIG_FILE: _json(config), STATISTICS_FILE: _json({**known, **changed})}
    for name, content in files.items():
        (folder / name).write_bytes(content)
    save_torch_state_dict(dict(weights), folder, max_shard_size=MAX_SHARD)


def changed_statistics(norm_stats: NormStats, known: NormStats) -> NormStats:
    """Entries that `known` lacks, or has with other numbers, as of a dataset that has grown since."""
    before, now = used_statistics(known), used_statistics(norm_stats)
    return {key: entry for key, entry in norm_stats.items() if before.get(key) != now[key]}


def original_config(sizes: Sizes) -> dict[str, Any]:
    """`config.json` as OpenVLA has it, for a model that never had one."""
    llama = sizes.llama
    text = {
        "model_type": "llama", "pad_token_id": llama.tokenizer_size, "vocab_size": llama.vocab_size,
        "hidden_size": llama.width, "intermediate_size": llama.mlp_size, "num_hidden_layers": llama.depth,
        "num_attention_heads": llama.heads, "num_key_value_heads": llama.kv_heads,
        "rms_norm_eps": llama.norm_eps, "rope_theta": llama.rope_theta,
        "max_position_embeddings": llama.max_positions,
    }  # fmt: skip
    return {
        "architectures": ["OpenVLAForActionPrediction"], "model_type": "openvla",
        "arch_specifier": "no-align+fused-gelu-mlp", "llm_backbone_id": "llama2-7b-pure",
        "vision_backbone_id": "dinosiglip-vit-so-224px", "hf_llm_id": "meta-llama/Llama-2-7b-hf",
        "timm_model_ids": list(VIT_IDS.values()), "timm_override_act_layers": [None, None],
        "image_sizes": [sizes.image_size] * 2, "llm_max_length": llama.max_positions,
        "pad_to_multiple_of": llama.extra_ids, "pad_token_id": llama.tokenizer_size,
        "text_config": text, **SUPPORTED,
    }  # fmt: skip


def vit_overrides(sizes: Sizes) -> dict[str, Any]:
    """The sidecar that tells what the vision transformers' timm ids do not."""

    def changed(vit: ViTSizes) -> dict[str, int]:
        return {"embed_dim": vit.width, "depth": vit.depth, "num_heads": vit.heads}

    overrides = {VIT_IDS[DINO]: changed(sizes.dino), VIT_IDS[SIGLIP]: changed(sizes.siglip)}
    return {"timm_create_model_overrides": overrides}


def _json(content: Any) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()
