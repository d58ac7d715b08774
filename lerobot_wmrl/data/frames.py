"""Frames at which imaginations begin, and the context of their episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor


@dataclass(frozen=True)
class Context:
    """Features of the first frames of B episodes, maps (B, N, C, h, w); none without the option `context`.

    The first map holds their features at the coarsest scale. The others are what each fusion of the tokenizer
    adds to its features, which is the same for every frame of an episode: the encoder's, then the decoder's
    from coarse to fine. Callers that use the dynamics alone can leave these out.
    """

    maps: tuple[Tensor, ...] = ()

    def __getitem__(self, rows: Any) -> "Context":
        """Return some of the B rows: an index, mask or slice of the first dimension."""
        return Context(tuple(each[rows] for each in self.maps))

    def __len__(self) -> int:
        return len(self.maps[0]) if self.maps else 0

    @classmethod
    def joined(cls, parts: Sequence["Context"]) -> "Context":
        """Put the contexts of several parts together."""
        return cls(tuple(torch.cat(each) for each in zip(*(part.maps for part in parts), strict=True)))

    @property
    def features(self) -> Tensor:
        """Coarsest features, (B, N, C, h, w)."""
        return self.maps[0]

    def replaced(self, mask: Tensor, new: "Context") -> "Context":
        """Return a copy with the rows of `new` where `mask` (B,) is True."""
        return Context(
            tuple(
                torch.where(mask[:, None, None, None, None], b, a)
                for a, b in zip(self.maps, new.maps, strict=True)
            )
        )

    def projections(self) -> list[Tensor]:
        """Return what the tokenizer's fusions add, [(B·N, C, h, w), …], cameras as rows of the batch."""
        return [each.flatten(0, 1) for each in self.maps[1:]]


NO_CONTEXT: Final = Context()


@dataclass(frozen=True)
class Frames:
    """What an imagination knows of the moment it begins at, for B episodes.

    Args:
        tokens: (B, S), the tokenizer's.
        state: (B, P), in the dataset's units.
        context: context of the first frames of the B episodes, where the tokenizer is conditioned on them.
        depth: (B, S) metres of each token, for world models that look at depth.
        instruction_weights: (B, E), by which the instruction lets success be read, for world models that
            read it.
    """

    tokens: Tensor
    state: Tensor
    context: Context = NO_CONTEXT
    depth: Tensor | None = None
    instruction_weights: Tensor | None = None

    def __getitem__(self, rows: Any) -> "Frames":
        """Return some of the B rows: an index, mask or slice of the first dimension."""
        depth, weights = (
            each if each is None else each[rows] for each in (self.depth, self.instruction_weights)
        )
        return Frames(self.tokens[rows], self.state[rows], self.context[rows], depth, weights)

    def __len__(self) -> int:
        return len(self.tokens)
