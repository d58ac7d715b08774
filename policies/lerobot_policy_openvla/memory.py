"""Is there room for the weights? Said before they are read, with the numbers."""

import psutil
import torch

GB = 1e9
CONVERTED = "use --policy.dtype=bfloat16, another --policy.device, or a machine with more memory"
AS_STORED = "end other programs, or use a machine with more memory"
"""What helps, where the weights get the policy's number format and where they keep their own."""


def free_memory(device: torch.device | str) -> int:
    """Bytes that a model may still take on `device`."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return int(psutil.virtual_memory().available)


def require_memory(needed: int, device: torch.device | str, remedy: str) -> None:
    """ValueError that ends with `remedy` if `needed` bytes of weights do not fit on `device`."""
    free = free_memory(device)
    if needed > free:
        raise ValueError(
            f"the policy's weights take {needed / GB:.1f} GB on {device}, {free / GB:.1f} GB are free; "
            f"{remedy}"
        )
