"""OpenVLA's own checkpoint format, read and written: weights in one file or shards, and files beside them."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from huggingface_hub import save_torch_state_dict, snapshot_download
from huggingface_hub.constants import SAFETENSORS_INDEX_FILE, SAFETENSORS_SINGLE_FILE
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_policy_openvla.actions import BINS, NormStats, used_statistics
from lerobot_policy_openvla.sizes import (
    DINO,
    RELEASED_HEADS,
    SIGLIP,
    VIT_FILE,
    Shapes,
    Sizes,
    ViTSizes,
    sizes_from_weights,
)
from lerobot_wmrl.common.checkpoints import may_be_on_hub

CONFIG_FILE: Final = "config.json"
ORIGINAL_CONFIG_FILE: Final = "openvla_config.json"
"""Name of OpenVLA's `config.json` beside LeRobot's."""

STATISTICS_FILE: Final = "dataset_statistics.json"
TOKENIZER_FILE: Final = "tokenizer.json"
COMPANIONS: Final = (
    TOKENIZER_FILE,
    "tokenizer.model",
    "tokenizer_config.json",
    "special_tokens_map.json",
    "added_tokens.json",
    "preprocessor_config.json",
    "processor_config.json",
    "generation_config.json",
    STATISTICS_FILE,
    VIT_FILE,
)
"""Small files beside the weights, kept as they are."""

RELEASE: Final = "openvla/openvla-7b"
"""The released checkpoint, whose folder on the hub holds OpenVLA's code."""

VIT_IDS: Final = {DINO: "vit_large_patch14_reg4_dinov2.lvd142m", SIGLIP: "vit_so400m_patch14_siglip_224"}
SUPPORTED: Final = {
    "image_resize_strategy": "resize-naive",
    "use_fused_vision_backbone": True,
    "n_action_bins": BINS,
}
RENAMED: Final = (".gamma", ".scale_factor")
"""LayerScale's parameter: timm's name, which some fine-tuned checkpoints have, and OpenVLA's."""

UNUSED_SUFFIX: Final = "rotary_emb.inv_freq"
"""A buffer that old versions of transformers stored; it is computed anew."""

MAX_SHARD: Final = "5GB"

Files = dict[str, bytes]
"""Name → content of the files beside the weights."""


@dataclass(frozen=True)
class OpenVLACheckpoint:
    """A checkpoint on disk: its configuration, the files beside it, and in which file each weight is."""

    folder: Path
    config: dict[str, Any]
    companions: Files
    locations: dict[str, Path]

    @classmethod
    def open(cls, source: str | Path) -> "OpenVLACheckpoint":
        """Open a folder or a hub id. Raises ValueError that names what is missing."""
        folder = resolve_folder(source)
        if not (folder / CONFIG_FILE).is_file():
            raise ValueError(f"{source}: {CONFIG_FILE} is missing: this is no OpenVLA checkpoint")
        content = (folder / CONFIG_FILE).read_bytes()
        config = json.loads(content)
        for name, value in SUPPORTED.items():
            if config.get(name, value) != value:
                raise ValueError(f"{source}: {name}={config[name]}: only {value} is supported")
        companions = {**read_companions(folder), ORIGINAL_CONFIG_FILE: content}
        if TOKENIZER_FILE not in companions:
            raise ValueError(f"{source}: {TOKENIZER_FILE} is missing beside the weights")
        files = weight_files(folder).items()
        return cls(
            folder, config, companions, {n: path for n, path in files if not n.endswith(UNUSED_SUFFIX)}
        )

    @property
    def norm_stats(self) -> NormStats:
        """`dataset_statistics.json` where there is one, else what the configuration holds."""
        if STATISTICS_FILE in self.companions:
            return json.loads(self.companions[STATISTICS_FILE])
        return self.config.get("norm_stats") or {}

    @property
    def sizes(self) -> Sizes:
        """Sizes of all parts, from the weights' shapes and the configuration.

        Raises:
            ValueError: if patches do not cover the images of the configuration's size, as 27 patches of 14
                pixels do not cover 384.
        """
        sizes = sizes_from_weights(self.shapes(), self.config, self._heads())
        sides = self.config.get("image_sizes") or [sizes.image_size]
        if set(sides) != {sizes.image_size}:
            raise ValueError(
                f"{self.folder}: image_sizes={sides}: the weights are for pictures of {sizes.image_size} "
                f"pixels in patches of {sizes.patch_size}; only pictures that patches cover are supported"
            )
        return sizes

    def shapes(self) -> Shapes:
        """Return the shape of every weight, by the network's name for it. No weight is read."""
        shapes: dict[str, tuple[int, ...]] = {}
        for path in sorted(set(self.locations.values())):
            with safe_open(path, framework="pt") as file:
                names = [name for name, location in self.locations.items() if location == path]
                shapes |= {name.replace(*RENAMED): tuple(file.get_slice(name).get_shape()) for name in names}
        return shapes

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Yield every weight as it is stored, by the network's name for it."""
        return ((name.replace(*RENAMED), tensor) for name, tensor in read_tensors(self.locations))

    def _heads(self) -> dict[str, int]:
        """Return the heads of the vision transformers, where a file tells them."""
        if VIT_FILE not in self.companions:
            return {}
        overrides = json.loads(self.companions[VIT_FILE])["timm_create_model_overrides"]
        return {prefix: overrides[name]["num_heads"] for prefix, name in VIT_IDS.items() if name in overrides}


def resolve_folder(source: str | Path, revision: str | None = None) -> Path:
    """Return a folder, or the folder that a hub id is downloaded to. Raises ValueError if there is none."""
    folder = Path(source)
    if folder.is_dir():
        return folder
    if not may_be_on_hub(source):
        raise ValueError(f"{source}: no such folder")
    patterns = [CONFIG_FILE, *COMPANIONS, ORIGINAL_CONFIG_FILE, "*.safetensors", SAFETENSORS_INDEX_FILE]
    try:
        return Path(snapshot_download(str(source), revision=revision, allow_patterns=patterns))
    except (OSError, ValueError) as error:  # the hub's errors are of both kinds
        raise ValueError(f"{source}: neither a folder nor a model on the hub ({error})") from error


def read_companions(folder: Path) -> Files:
    """Read the files of `COMPANIONS` that exist, and the original configuration if it exists."""
    names = (*COMPANIONS, ORIGINAL_CONFIG_FILE)
    return {name: (folder / name).read_bytes() for name in names if (folder / name).is_file()}


def weight_files(folder: Path) -> dict[str, Path]:
    """Return weight → its file. Raises ValueError for a missing shard or weight, or a damaged file."""
    index = folder / SAFETENSORS_INDEX_FILE
    if index.is_file():
        files = {name: folder / file for name, file in json.loads(index.read_text())["weight_map"].items()}
        for path in sorted(set(files.values())):
            _require_names(path, [name for name, file in files.items() if file == path])
        return files
    path = folder / SAFETENSORS_SINGLE_FILE
    return dict.fromkeys(_require_names(path, []), path)


def stored_bytes(locations: dict[str, Path]) -> int:
    """Return the bytes of the files of weights, and of the weights in memory in their own number format."""
    return sum(path.stat().st_size for path in set(locations.values()))


def read_tensors(locations: dict[str, Path]) -> Iterator[tuple[str, Tensor]]:
    """Yield every weight as it is stored, one at a time, file by file."""
    for path in sorted(set(locations.values())):
        with safe_open(path, framework="pt") as file:
            for name in [name for name, location in locations.items() if location == path]:
                yield name, file.get_tensor(name)


def _require_names(path: Path, names: list[str]) -> list[str]:
    """Return the names of the weights in a file. Raises ValueError if it is damaged or lacks `names`."""
    if not path.is_file():
        raise ValueError(f"{path}: this file of weights is missing; download the checkpoint again")
    try:
        with safe_open(path, framework="pt") as file:
            stored = list(file.keys())
    except SafetensorError as error:
        raise ValueError(f"{path}: cannot be read ({error}); download the checkpoint again") from error
    missing = sorted(set(names) - set(stored))
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing[:5])}, which {SAFETENSORS_INDEX_FILE} has there")
    return stored


def write_openvla(
    folder: Path, weights: Mapping[str, Tensor], sizes: Sizes, companions: Files, norm_stats: NormStats
) -> None:
    """Write a checkpoint that OpenVLA's own code loads, sharded like the release where it is large.

    Args:
        folder: created if it does not exist.
        weights: weights by OpenVLA's names.
        sizes: sizes of the model; needed where no original configuration is among `companions`.
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
    for name, content in with_released_code(files).items():
        (folder / name).write_bytes(content)
    save_torch_state_dict(dict(weights), folder, max_shard_size=MAX_SHARD)


def with_released_code(files: Files) -> Files:
    """Let `auto_map` name the code of the release on the hub: it names Python files beside a checkpoint, of
    which there are none here, and transformers looks for them with `trust_remote_code`, as OpenVLA does."""
    mapped = {name: json.loads(content) for name, content in files.items() if b'"auto_map"' in content}
    for content in mapped.values():
        content["auto_map"] = {
            kind: each if not isinstance(each, str) or "--" in each else f"{RELEASE}--{each}"
            for kind, each in content["auto_map"].items()
        }
    return {**files, **{name: _json(content) for name, content in mapped.items()}}


def changed_statistics(norm_stats: NormStats, known: NormStats) -> NormStats:
    """Return the entries that `known` lacks, or has with other values, as of a dataset that has grown."""
    before, now = used_statistics(known), used_statistics(norm_stats)
    return {key: entry for key, entry in norm_stats.items() if before.get(key) != now[key]}


def original_config(sizes: Sizes) -> dict[str, Any]:
    """Return OpenVLA's `config.json` for a model that never had one."""
    llama = sizes.llama
    text = {
        "model_type": "llama",
        "pad_token_id": llama.tokenizer_size,
        "vocab_size": llama.vocab_size,
        "hidden_size": llama.width,
        "intermediate_size": llama.mlp_size,
        "num_hidden_layers": llama.depth,
        "num_attention_heads": llama.heads,
        "num_key_value_heads": llama.kv_heads,
        "rms_norm_eps": llama.norm_eps,
        "rope_theta": llama.rope_theta,
        "max_position_embeddings": llama.max_positions,
    }
    return {
        "architectures": ["OpenVLAForActionPrediction"],
        "model_type": "openvla",
        "arch_specifier": "no-align+fused-gelu-mlp",
        "llm_backbone_id": "llama2-7b-pure",
        "vision_backbone_id": "dinosiglip-vit-so-224px",
        "hf_llm_id": "meta-llama/Llama-2-7b-hf",
        "timm_model_ids": list(VIT_IDS.values()),
        "timm_override_act_layers": [None, None],
        "image_sizes": [sizes.image_size] * 2,
        "llm_max_length": llama.max_positions,
        "pad_to_multiple_of": llama.extra_ids,
        "pad_token_id": llama.tokenizer_size,
        "text_config": text,
        **SUPPORTED,
    }


def vit_overrides(sizes: Sizes) -> dict[str, Any]:
    """Return the file that tells what the vision transformers' timm ids do not."""

    def changed(vit: ViTSizes) -> dict[str, int]:
        return {"embed_dim": vit.width, "depth": vit.depth, "num_heads": vit.heads}

    overrides = {VIT_IDS[DINO]: changed(sizes.dino), VIT_IDS[SIGLIP]: changed(sizes.siglip)}
    return {"timm_create_model_overrides": overrides}


def _json(content: Any) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()
