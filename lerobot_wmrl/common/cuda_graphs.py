"""CUDA graphs for modules whose many small kernels take longer to launch than to run."""

import copy
from typing import Any

import torch
from torch import nn
from torch.utils._pytree import tree_leaves, tree_map


class GraphedInTraining:
    """Calls a module; training on CUDA replays its forward and its backward pass as one CUDA graph each.

    They are captured at the first call with inputs of a shape, by `torch.cuda.make_graphed_callables`. Each
    forward pass must be followed by its backward pass, and the gradients used, before the next one: all
    replays write to the same memory.
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
        if not (tensors[0].is_cuda and self._module.training and torch.is_grad_enabled()):
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
