"""CUDA graphs for modules whose many small kernels take longer to launch than to run."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Final

import torch
from torch import nn
from torch.utils._pytree import tree_leaves, tree_map

ALLOWED: Final = ContextVar("ALLOWED", default=False)


@contextmanager
def cuda_graphs() -> Iterator[None]:
    """Let the modules that are called in the block train as CUDA graphs.

    The caller makes sure that no other thread uses CUDA meanwhile (a DataLoader that pins memory does), which
    would break a capture; and that each forward pass is followed by its backward pass, and the gradients
    used, before the next one, since all replays write to the same memory.
    """
    token = ALLOWED.set(True)
    try:
        yield
    finally:
        ALLOWED.reset(token)


class GraphedInTraining:
    """Calls a module; on CUDA, in training and within `cuda_graphs`, its passes are one CUDA graph each.

    They are captured at the first call with inputs of a shape, by `torch.cuda.make_graphed_callables`.
    """

    def __init__(self, module: nn.Module) -> None:
        self._module = module
        self._graphs: dict[object, Any] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "GraphedInTraining":
        """The copy captures graphs of its own, since a graph reads the weights that it was captured with."""
        return GraphedInTraining(copy.deepcopy(self._module, memo))

    def __call__(self, *inputs: Any) -> Any:
        """Call the module with tensors, or tuples of them."""
        tensors = tree_leaves(inputs)
        trains = self._module.training and torch.is_grad_enabled()
        if not (ALLOWED.get() and trains and tensors[0].is_cuda):
            return self._module(*inputs)
        weights = next(self._module.parameters()).data_ptr()  # which Module.to(…) changes
        key = weights, *((tensor.shape, tensor.dtype, tensor.requires_grad) for tensor in tensors)
        if key not in self._graphs:
            samples = tree_map(like, inputs)
            # The capture replaces `forward` of what it is given: here of a copy that shares the weights.
            with torch.autocast("cuda", enabled=False):
                self._graphs[key] = torch.cuda.make_graphed_callables(
                    copy.copy(self._module), samples, allow_unused_input=True
                )
        return self._graphs[key](*inputs)


def like(tensor: torch.Tensor) -> torch.Tensor:
    """Return a copy that gradients stop at, and that wants one where the tensor does."""
    return tensor.detach().clone().requires_grad_(tensor.requires_grad)
