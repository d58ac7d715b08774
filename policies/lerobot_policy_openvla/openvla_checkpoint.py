"""OpenVLA's own checkpoint format, read: weights in one file or in shards, and what lies beside them."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from huggingface_hub import snapshot_download
from huggingface_hub.constants import SAFETENSORS_INDEX_FILE, SAFETENSORS_SINGLE_FILE
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_policy_openvla.action_tokens import BINS
from lerobot_policy_openvla.sizes import DINO, SIGLIP, VIT_FILE, Shapes, Sizes, sizes_from_weights
from lerobot_policy_openvla.statistics import NormStats

CONFIG_FILE: Final = "config.json"
ORIGINAL_CONFIG_FILE: Final = "openvla_config.json"
"""What `config.json` is called beside LeRobot's."""

STATISTICS_FILE: Final = "dataset_statistics.json"
TOKENIZER_FILE: Final = "tokenizer.json"
COMPANIONS: Final = (
    TOKENIZER_FILE, "tokenizer.model", "tokenizer_config.json", "special_tokens_map.json",
    "added_tokens.json", "preprocessor_config.json", "processor_config.json", "generation_config.json",
    STATISTICS_FILE, VIT_FILE,
)  # fmt: skip
"""Small files beside the weights, kept as they are."""

VIT_IDS: Final = {DINO: "vit_large_patch14_reg4_dinov2.lvd142m", SIGLIP: "vit_so400m_patch14_siglip_224"}
SUPPORTED: Final = {
    "image_resize_strategy": "resize-naive", "use_fused_vision_backbone": True, "n_action_bins": BINS,
}  # fmt: skip
RENAMED: Final = (".gamma", ".scale_factor")
"""LayerScale's parameter: timm's name, which some fine-tuned checkpoints have, and OpenVLA's."""

UNUSED_SUFFIX: Final = "rotary_emb.inv_freq"
"""A buffer that old versions of transformers stored; it is computed anew."""

Files = dict[str, bytes]
"""Name → content of what lies beside the weights."""


@dataclass(frozen=True)
class OpenVLACheckpoint:
    """A checkpoint on disk: its configuration, the files beside it, and in which file each weight is."""

    folder: Path
    config: dict[str, Any]
    companions: Files
    locations: dict[str, Path]

    @classmethod
    def open(cls, source: str | Path) -> "OpenVLACheckpoint":
        """From a folder or a hub id. ValueError names what is missing."""
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
        """Of all parts, from the weights' shapes and the configuration. ValueError if patches do not cover
        the pictures that the configuration tells of, as 27 patches of 14 pixels do not cover 384."""
        sizes = sizes_from_weights(self.shapes(), self.config, self._heads())
        told = self.config.get("image_sizes") or [sizes.image_size]
        if set(told) != {sizes.image_size}:
            raise ValueError(
                f"{self.folder}: image_sizes={told}: the weights are for pictures of {sizes.image_size} "
                f"pixels in patches of {sizes.patch_size}; only pictures that patches cover are supported"
            )
        return sizes

    def shapes(self) -> Shapes:
        """Of every weight, by the name that the network gives it; none is read."""
        shapes: dict[str, tuple[int, ...]] = {}
        for path in sorted(set(self.locations.values())):
            with safe_open(path, framework="pt") as file:
                names = [name for name, location in self.locations.items() if location == path]
                shapes |= {name.replace(*RENAMED): tuple(file.get_slice(name).get_shape()) for name in names}
        return shapes

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Every weight as it is stored, by the name that the network gives it."""
        return ((name.replace(*RENAMED), tensor) for name, tensor in read_tensors(self.locations))

    def _heads(self) -> dict[str, int]:
        """Of the vision transformers, where the file that tells them is there."""
        if VIT_FILE not in self.companions:
            return {}
        overrides = json.loads(self.companions[VIT_FILE])["timm_create_model_overrides"]
        return {prefix: overrides[name]["num_heads"] for prefix, name in VIT_IDS.items() if name in overrides}


def resolve_folder(source: str | Path, revision: str | None = None) -> Path:
    """A folder as it is, a hub id as the folder it is downloaded to. ValueError if there is neither."""
    folder = Path(source)
    if folder.is_dir():
        return folder
    if folder.is_absolute() or str(source).startswith("."):
        raise ValueError(f"{source}: no such folder")
    patterns = [CONFIG_FILE, *COMPANIONS, ORIGINAL_CONFIG_FILE, "*.safetensors", SAFETENSORS_INDEX_FILE]
    try:
        return Path(snapshot_download(str(source), revision=revision, allow_patterns=patterns))
    except (OSError, ValueError) as error:  # the hub's errors are of both kinds
        raise ValueError(f"{source}: neither a folder nor a model on the hub ({error})") from error


def read_companions(folder: Path) -> Files:
    """Those of `COMPANIONS` that are there, and the original configuration if it is kept there."""
    names = (*COMPANIONS, ORIGINAL_CONFIG_FILE)
    return {name: (folder / name).read_bytes() for name in names if (folder / name).is_file()}


def weight_files(folder: Path) -> dict[str, Path]:
    """Weight → its file. ValueError names a shard or a weight that is missing, or a file that is torn."""
    index = folder / SAFETENSORS_INDEX_FILE
    if index.is_file():
        files = {name: folder / file for name, file in json.loads(index.read_text())["weight_map"].items()}
        for path in sorted(set(files.values())):
            _require_names(path, [name for name, file in files.items() if file == path])
        return files
    path = folder / SAFETENSORS_SINGLE_FILE
    return dict.fromkeys(_require_names(path, []), path)


def stored_bytes(locations: dict[str, Path]) -> int:
    """What the files of weights take, and the weights in memory while they keep their number format."""
    return sum(path.stat().st_size for path in set(locations.values()))


def read_tensors(locations: dict[str, Path]) -> Iterator[tuple[str, Tensor]]:
    """Every weight as it is stored, one at a time, file by file."""
    for path in sorted(set(locations.values())):
        with safe_open(path, framework="pt") as file:
            for name in [name for name, location in locations.items() if location == path]:
                yield name, file.get_tensor(name)


def _require_names(path: Path, names: list[str]) -> list[str]:
    """The weights in a file. ValueError if it is missing or torn, or lacks one of `names`."""
    if not path.is_file():
        raise ValueError(f"{path}: this file of weights is missing; download the checkpoint again")
    try:
        with safe_open(path, framework="pt") as file:
            found = list(file.keys())
    except SafetensorError as error:
        raise ValueError(f"{path}: cannot be read ({error}); download the checkpoint again") from error
    missing = sorted(set(names) - set(found))
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing[:5])}, which {SAFETENSORS_INDEX_FILE} has there")
    return found
