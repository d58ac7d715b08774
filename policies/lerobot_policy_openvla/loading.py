"""From a checkpoint to a policy: its configuration, its number format, its weights."""

import json
from collections.abc import Iterable
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.openvla_checkpoint import CONFIG_FILE, OpenVLACheckpoint
from lerobot_policy_openvla.statistics import choose_key, used_statistics
from lerobot_wmrl.common.precision import multiplies_bfloat16

NAMED = 5
"""Weights that an error names before it only counts them."""


def compute_dtype(name: str, device: str, random_start: bool = False) -> torch.dtype:
    """What `policy.dtype` means on `device`. ValueError if a CPU is asked for a format it does not have.

    `auto` is float32 for a random start, since all of its weights must be trained.
    """
    kind = torch.device(device).type
    if name == "bfloat16" and kind == "cpu" and not multiplies_bfloat16(device):
        raise ValueError(
            "policy.dtype=bfloat16: this CPU has no instructions for it (AVX512-BF16 or AMX); use "
            "--policy.dtype=float32 or auto"
        )
    if name == "auto" and not random_start and kind == "cuda" and multiplies_bfloat16(device):
        return torch.bfloat16
    return torch.bfloat16 if name == "bfloat16" else torch.float32


def openvla_config(
    checkpoint: OpenVLACheckpoint, unnorm_key: str | None, device: str, dtype: str
) -> OpenVLAConfig:
    """Of a checkpoint in OpenVLA's own format; its cameras are left to the first dataset or environment."""
    norm_stats = used_statistics(checkpoint.norm_stats)
    key = choose_key(norm_stats, unnorm_key)
    config = OpenVLAConfig(
        sizes=checkpoint.sizes, norm_stats=norm_stats, unnorm_key=key, device=device, dtype=dtype
    )
    if key is not None:
        shape = (len(norm_stats[key]["action"]["q01"]),)
        config.output_features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=shape)}
    return config


def check_key(config: OpenVLAConfig) -> None:
    """ValueError if `unnorm_key` is not the one that the processors beside the weights were made with."""
    stored = Path(config.pretrained_path or "") / CONFIG_FILE
    made_with = json.loads(stored.read_text()).get("unnorm_key") if stored.is_file() else config.unnorm_key
    if made_with != config.unnorm_key:
        raise ValueError(
            f"policy.unnorm_key={config.unnorm_key}: the processors in {config.pretrained_path} are for "
            f"{made_with}; import the checkpoint again, with this key"
        )


def fill(module: nn.Module, tensors: Iterable[tuple[str, Tensor]], device: str, source: str) -> None:
    """Put weights into `module`, every one of them, in the format they have, on `device`.

    Args:
        tensors: by the names of the module's weights.
        source: to name in errors: ValueError if a weight is missing, unknown or of another shape.
    """
    expected = module.state_dict()
    loaded: dict[str, Tensor] = {}
    for name, tensor in tensors:
        _require_shape(source, name, expected.get(name), tensor)
        loaded[name] = tensor.to(device)
    missing = sorted(expected.keys() - loaded.keys())
    if missing:
        raise ValueError(f"{source}: {_named(missing)} missing; this is no whole checkpoint of these sizes")
    module.load_state_dict(loaded, assign=True)


def _require_shape(source: str, name: str, expected: Tensor | None, tensor: Tensor) -> None:
    if expected is None:
        raise ValueError(f"{source}: the weight {name} is unknown; this is another kind of model")
    if expected.shape != tensor.shape:
        raise ValueError(
            f"{source}: the weight {name} is {tuple(tensor.shape)}, expected {tuple(expected.shape)}"
        )


def _named(names: list[str]) -> str:
    shown = ", ".join(names[:NAMED])
    return f"the weight {shown} is" if len(names) == 1 else f"{len(names)} weights ({shown}, …) are"
