"""The sizes of a model: stated by a configuration, or read from the names and shapes of its weights."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from lerobot_wmrl.common.errors import FieldError

Shapes = Mapping[str, tuple[int, ...]]
"""Name of a weight → its shape."""

CHANNELS: Final = 3
EXTRA_IDS: Final = 64
"""OpenVLA's `pad_to_multiple_of`: embedding rows beyond the tokenizer's vocabulary, the first for `<PAD>`."""


@dataclass
class ViTSizes:
    """Sizes of a vision transformer. It has registers only with a class token."""

    width: int = 64
    depth: int = 4
    heads: int = 4
    mlp_size: int = 256
    class_token: bool = False
    registers: int = 0

    def __post_init__(self) -> None:
        if self.depth < 2:
            problem = "must be at least 2, because features come from the block before the last"
            raise FieldError("depth", self.depth, problem)
        if self.width % self.heads:
            raise FieldError("width", self.width, f"must be a multiple of heads={self.heads}")


@dataclass
class LlamaSizes:
    """Sizes of the language model. The action tokens are the last 256 of the `vocab_size − extra_ids` ids."""

    width: int = 128
    depth: int = 4
    heads: int = 4
    kv_heads: int = 4
    mlp_size: int = 352
    vocab_size: int = 1024 + EXTRA_IDS
    extra_ids: int = EXTRA_IDS
    norm_eps: float = 1e-6
    rope_theta: float = 10000.0
    max_positions: int = 2048

    def __post_init__(self) -> None:
        if self.width % (2 * self.heads):
            problem = f"must be a multiple of twice heads={self.heads}: positions rotate pairs of channels"
            raise FieldError("sizes.llama.width", self.width, problem)
        if self.heads % self.kv_heads:
            problem = f"must be a multiple of kv_heads={self.kv_heads}"
            raise FieldError("sizes.llama.heads", self.heads, problem)

    @property
    def tokenizer_size(self) -> int:
        """Ids that the tokenizer can produce; the id after them is `<PAD>`."""
        return self.vocab_size - self.extra_ids


@dataclass
class DinoSizes(ViTSizes):
    """Sizes of DINOv2, whose images have a class token and registers beside their patches."""

    class_token: bool = True
    registers: int = 4


@dataclass
class Sizes:
    """Sizes of the whole model. By default small enough for two CPU cores."""

    image_size: int = 64
    patch_size: int = 8
    dino: DinoSizes = field(default_factory=DinoSizes)
    siglip: ViTSizes = field(default_factory=ViTSizes)
    llama: LlamaSizes = field(default_factory=LlamaSizes)

    def __post_init__(self) -> None:
        if self.image_size % self.patch_size:
            raise ValueError(
                f"sizes.image_size={self.image_size}: must be a multiple of patch_size={self.patch_size}"
            )

    @property
    def patches(self) -> int:
        """Number of patches of one image."""
        return (self.image_size // self.patch_size) ** 2


RELEASED: Final = Sizes(
    image_size=224,
    patch_size=14,
    dino=DinoSizes(width=1024, depth=24, heads=16, mlp_size=4096),
    siglip=ViTSizes(width=1152, depth=27, heads=16, mlp_size=4304),
    llama=LlamaSizes(width=4096, depth=32, heads=32, kv_heads=32, mlp_size=11008, vocab_size=32064),
)
"""Sizes of openvla/openvla-7b."""

RELEASED_HEADS: Final = {
    RELEASED.dino.width: RELEASED.dino.heads,
    RELEASED.siglip.width: RELEASED.siglip.heads,
}
"""Width → heads of timm's models, as heads leave no trace in the shapes."""

VIT_FILE: Final = "tiny_vit.json"
"""File that tells the heads of vision transformers of other widths."""

DINO, SIGLIP = "vision_backbone.featurizer.", "vision_backbone.fused_featurizer."
LLAMA = "language_model."


def sizes_from_weights(shapes: Shapes, config: Mapping[str, Any], heads: Mapping[str, int]) -> Sizes:
    """Read the sizes of a checkpoint.

    Args:
        shapes: shapes of all its weights.
        config: `config.json`'s content, for the sizes that leave no trace in the shapes; the release's
            where its `text_config` is silent (32 heads, norm_eps 1e-6, rope_theta 10000).
        heads: heads of the vision transformers by weight prefix, where they are known.
    """
    patch_size = shape_of(shapes, f"{DINO}patch_embed.proj.weight")[-1]
    patches = shape_of(shapes, f"{DINO}pos_embed")[1]
    return Sizes(
        image_size=math.isqrt(patches) * patch_size,
        patch_size=patch_size,
        dino=_vit_sizes(DinoSizes, shapes, DINO, heads),
        siglip=_vit_sizes(ViTSizes, shapes, SIGLIP, heads),
        llama=_llama_sizes(shapes, config),
    )


def shape_of(shapes: Shapes, name: str) -> tuple[int, ...]:
    """Return the shape of a weight. Raises ValueError if it is missing."""
    if name not in shapes:
        raise ValueError(f"the weight {name} is missing: this is no whole OpenVLA checkpoint")
    return shapes[name]


def _vit_sizes[VitSizes: ViTSizes](
    kind: type[VitSizes], shapes: Shapes, prefix: str, heads: Mapping[str, int]
) -> VitSizes:
    width = shape_of(shapes, f"{prefix}patch_embed.proj.weight")[0]
    registers = shapes.get(f"{prefix}reg_token", (1, 0, width))[1]
    return kind(
        width=width,
        depth=_depth(shapes, f"{prefix}blocks."),
        heads=heads.get(prefix) or vit_heads(prefix, width),
        mlp_size=shape_of(shapes, f"{prefix}blocks.0.mlp.fc1.weight")[0],
        class_token=f"{prefix}cls_token" in shapes,
        registers=registers,
    )


def vit_heads(prefix: str, width: int) -> int:
    """Return the heads of the released models; for other widths assume 16 channels a head, with a warning."""
    if width in RELEASED_HEADS:
        return RELEASED_HEADS[width]
    logging.warning(
        f"{prefix[:-1]} is {width} wide; the weights do not tell its number of heads, {max(1, width // 16)} "
        f"are assumed. {VIT_FILE} beside the weights would tell: timm_create_model_overrides, num_heads"
    )
    return max(1, width // 16)


def _llama_sizes(shapes: Shapes, config: Mapping[str, Any]) -> LlamaSizes:
    layers, text_config = f"{LLAMA}model.layers.", config.get("text_config", {})
    vocab_size, width = shape_of(shapes, f"{LLAMA}model.embed_tokens.weight")
    heads = text_config.get("num_attention_heads", RELEASED.llama.heads)
    keys = shape_of(shapes, f"{layers}0.self_attn.k_proj.weight")[0]
    return LlamaSizes(
        width=width,
        depth=_depth(shapes, layers),
        heads=heads,
        kv_heads=keys * heads // width,
        mlp_size=shape_of(shapes, f"{layers}0.mlp.gate_proj.weight")[0],
        vocab_size=vocab_size,
        extra_ids=config.get("pad_to_multiple_of", EXTRA_IDS),
        norm_eps=text_config.get("rms_norm_eps", RELEASED.llama.norm_eps),
        rope_theta=text_config.get("rope_theta", RELEASED.llama.rope_theta),
        max_positions=text_config.get("max_position_embeddings", RELEASED.llama.max_positions),
    )


def _depth(shapes: Shapes, prefix: str) -> int:
    """Return one more than the highest index behind `prefix`. Raises ValueError if there is none."""
    indices = [int(name[len(prefix) :].split(".")[0]) for name in shapes if name.startswith(prefix)]
    if not indices:
        raise ValueError(f"weights {prefix}* are missing: this is no whole OpenVLA checkpoint")
    return 1 + max(indices)
