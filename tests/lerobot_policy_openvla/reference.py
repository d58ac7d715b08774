"""Outputs of OpenVLA's original code (torch 2.2.0, transformers 4.40.1, timm 0.9.10, float32 on a CPU).

They are of a checkpoint with random weights in the release's layout. `reference/` holds what fits into a
repository: the rows of the embeddings that the samples need, all weights that contribute, every eighth patch
of the features, digests of the pixels. The whole checkpoint is used where it lies beside the repository.
"""

import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer, models
from torch import Tensor

EXCERPT = Path(__file__).parent / "reference"
WHOLE = Path(__file__).parents[3] / "shared" / "openvla_tiny"
RELEASED = json.loads((EXCERPT / "openvla_7b.json").read_text())
"""Weights of openvla/openvla-7b: name, with * for a layer's index → [layers, shape]."""

ROWS = {"embedding": "language_model.model.embed_tokens.weight", "head": "language_model.lm_head.weight"}
VOCABULARY, SPACE_ID = 32064, 29871


@dataclass(frozen=True)
class Reference:
    """A checkpoint's folder, arrays by name, pictures, and the numbers of the samples there are."""

    folder: Path
    arrays: dict[str, np.ndarray]
    images: Path
    samples: tuple[int, ...]
    patches: np.ndarray

    def __call__(self, name: str) -> Tensor:
        """An array, for example `s1_input_ids`, as a tensor."""
        return torch.from_numpy(self.arrays[name])

    def image(self, sample: int) -> Tensor:
        """uint8 (1, 3, H, W)"""
        picture = np.array(Image.open(self.images / f"image_{sample}.png").convert("RGB"))
        return torch.from_numpy(picture).permute(2, 0, 1)[None]

    def pixel_digest(self, sample: int) -> bytes:
        """SHA-256 of the float32 pixel values (6, 224, 224)."""
        if f"s{sample}_pixel_sha256" in self.arrays:
            return self.arrays[f"s{sample}_pixel_sha256"].tobytes()
        return hashlib.sha256(self.arrays[f"s{sample}_pixel_values"].tobytes()).digest()


def whole_reference() -> Reference:
    """The checkpoint beside the repository."""
    arrays = dict(np.load(WHOLE / "reference" / "reference.npz"))
    return Reference(WHOLE, arrays, WHOLE / "reference", (0, 1, 2), np.arange(256))


def excerpt_reference(folder: Path) -> Reference:
    """The committed part, as a checkpoint in `folder`; what is not known of it is 0."""
    arrays = dict(np.load(EXCERPT / "reference.npz"))
    for name in ("config.json", "dataset_statistics.json", "tiny_vit.json"):
        shutil.copy(EXCERPT / name, folder)
    vocab = {"<unk>": 0, "<s>": 1, "</s>": 2, "▁": SPACE_ID}
    Tokenizer(models.BPE(vocab, [], unk_token="<unk>")).save(str(folder / "tokenizer.json"))
    save_file(excerpt_weights(), folder / "model.safetensors")
    return Reference(folder, arrays, EXCERPT, (1, 2), arrays["patches"])


def excerpt_weights() -> dict[str, Tensor]:
    """Every weight of the layout by name."""
    weights = load_file(EXCERPT / "weights.safetensors")
    for part, name in ROWS.items():
        ids, rows = weights.pop(f"{part}_ids"), weights.pop(f"{part}_rows")
        weights[name] = rows.new_zeros(VOCABULARY, rows.shape[1]).index_copy(0, ids.long(), rows)
    return weights | unused_weights(weights)


def unused_weights(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The last blocks, last norms and the pooling head of the vision transformers, which nothing runs."""
    made = {}
    for prefix, last in (("vision_backbone.featurizer.", 2), ("vision_backbone.fused_featurizer.", 3)):
        width = weights[f"{prefix}blocks.0.norm1.weight"]
        first = {name: value for name, value in weights.items() if name.startswith(f"{prefix}blocks.0.")}
        made |= {name.replace("blocks.0.", f"blocks.{last}."): value * 0 for name, value in first.items()}
        made |= {f"{prefix}norm.{part}": width * 0 for part in ("weight", "bias")}
    width, hidden = (weights[f"{prefix}blocks.0.mlp.fc1.weight"].shape[side] for side in (1, 0))
    linear = {"q": (width, width), "kv": (2 * width, width), "proj": (width, width)}
    linear |= {"mlp.fc1": (hidden, width), "mlp.fc2": (width, hidden)}
    shapes: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in linear.items()}
    shapes |= {f"{name}.bias": shape[:1] for name, shape in linear.items()}
    shapes |= {"latent": (1, 1, width), "norm.weight": (width,), "norm.bias": (width,)}
    like = weights[f"{prefix}pos_embed"]
    return made | {f"{prefix}attn_pool.{name}": like.new_zeros(shape) for name, shape in shapes.items()}
