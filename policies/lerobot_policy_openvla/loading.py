"""From a checkpoint to a policy: its configuration, its number format, memory, its weights."""

import json
from collections.abc import Iterable
from pathlib import Path

import psutil
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_policy_openvla.actions import choose_key, used_statistics
from lerobot_policy_openvla.checkpoint import CONFIG_FILE, OpenVLACheckpoint
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.precision import multiplies_bfloat16

NAMED = 5
"""Largest number of weights that an error names."""

GB = 1e9
CONVERTED = "set `dtype` to bfloat16, use another `device`, or a machine with more memory"
AS_STORED = "end other programs, or use a machine with more memory"
"""Remedies where the weights are converted to the policy's number format, and where they keep their own."""


def compute_dtype(name: str, device: str, random_start: bool = False) -> torch.dtype:
    """Return the number format of `dtype` on a device.

    Args:
        name: auto, float32 or bfloat16.
        device: device of the policy.
        random_start: whether weights are random. `auto` is float32 then, since all weights must be trained.

    Raises:
        FieldError: for bfloat16 on a CPU without instructions for it.
    """
    kind = torch.device(device).type
    if name == "bfloat16" and kind == "cpu" and not multiplies_bfloat16(device):
        problem = "this CPU has no instructions for it (AVX512-BF16 or AMX)"
        raise FieldError("dtype", "bfloat16", problem, "set `dtype` to float32 or auto")
    if name == "auto" and not random_start and kind == "cuda" and multiplies_bfloat16(device):
        return torch.bfloat16
    return torch.bfloat16 if name == "bfloat16" else torch.float32


def openvla_config(
    checkpoint: OpenVLACheckpoint, unnorm_key: str | None, device: str, dtype: str
) -> OpenVLAConfig:
    """Return the configuration of a checkpoint in OpenVLA's own format.

    Its cameras are left to the first dataset or environment.
    """
    norm_stats = used_statistics(checkpoint.norm_stats)
    key = choose_key(norm_stats, unnorm_key)
    config = OpenVLAConfig(
        sizes=checkpoint.sizes, norm_stats=norm_stats, unnorm_key=key, device=device, dtype=dtype
    )
    if key is not None:
        shape = (len(norm_stats[key]["action"]["q01"]),)
        config.output_features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=shape)}
    return config


def check_key(config: OpenVLAConfig, source: str | Path, folder: Path) -> None:
    """Raise FieldError if the processors were made with another `unnorm_key`.

    Args:
        config: says where they are: beside the weights, or beside adapters.
        source: where the weights come from, a folder or a hub id.
        folder: where they are on this machine.
    """
    path = str(config.pretrained_path or source)
    stored = (folder if path == str(source) else Path(path)) / CONFIG_FILE
    made_with = json.loads(stored.read_text()).get("unnorm_key") if stored.is_file() else config.unnorm_key
    if made_with != config.unnorm_key:
        raise FieldError(
            "unnorm_key",
            config.unnorm_key,
            f"the processors in {path} are for {made_with}",
            "import the checkpoint again, with this key",
        )


def fill(module: nn.Module, tensors: Iterable[tuple[str, Tensor]], device: str, source: str) -> None:
    """Load all weights into a module, in the number format they have.

    Args:
        tensors: tensors by the names of the module's weights.
        source: source to name in errors: ValueError if a weight is missing, unknown or of another shape.
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


def free_memory(device: torch.device | str) -> int:
    """Return the free memory of `device` in bytes."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return int(psutil.virtual_memory().available)


def require_memory(needed: int, device: torch.device | str, remedy: str) -> None:
    """Raise FieldError, with the remedy, if `needed` bytes of weights do not fit on `device`."""
    free = free_memory(device)
    if needed > free:
        problem = f"the policy's weights take {needed / GB:.1f} GB on {device}, {free / GB:.1f} GB are free"
        raise FieldError("device", device, problem, remedy)
