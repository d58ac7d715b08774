"""How often numbers are fetched from tensors: on the CPU too, where nobody has to wait for them."""

from collections.abc import Callable
from typing import Any, Final

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

VALUES: Final = (torch.ops.aten._local_scalar_dense.default, torch.ops.aten.nonzero.default)
"""Of a tensor's one number, and of the places of True: their shape has to be known."""


class ReadBacks(TorchDispatchMode):
    """Counts what operations fetch: bool(), int(), item(), nonzero() and the choice of rows by a mask."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        by_mask = function is torch.ops.aten.index.Tensor and any(
            index is not None and index.dtype == torch.bool for index in arguments[1]
        )
        self.count += by_mask or function in VALUES
        return function(*arguments, **(named or {}))


class WholeTensors(TorchFunctionMode):
    """Counts what is fetched whole, which is no operation for tensors in the CPU's memory."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_function__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        self.count += function in (Tensor.tolist, Tensor.numpy, Tensor.cpu, Tensor.__array__)
        return function(*arguments, **(named or {}))


def fetched(work: Callable[[], Any]) -> int:
    """How often `work` fetches something."""
    with WholeTensors() as whole, ReadBacks() as values:
        work()
    return whole.count + values.count
