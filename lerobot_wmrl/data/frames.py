"""What is known of single frames, as the tokenizer and the world models see them."""

from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor


@dataclass(frozen=True)
class Context:
    """Of B first frames, maps (B, N, C, h, w); without the option none.

    The first map are their features at the coarsest scale. The others are what each fusion of the tokenizer
    adds to its features, which is the same for every frame of an episode: the encoder's, then the decoder's
    from coarse to fine. Who only asks the dynamics can leave these out.
    """

    maps: tuple[Tensor, ...] = ()

    def __getitem__(self, rows: Any) -> "Context":
        """The context of some of the B frames: an index, mask or slice of the first dimension."""
        return Context(tuple(each[rows] for each in self.maps))

    def __len__(self) -> int:
        return len(self.maps[0]) if self.maps else 0

    @property
    def features(self) -> Tensor:
        """(B, N, C, h, w)."""
        return self.maps[0]

    def replaced(self, mask: Tensor, new: "Context") -> "Context":
        """The rows of `new` where `mask` (B,) is True, else one's own."""
        return Context(
            tuple(
                torch.where(mask[:, None, None, None, None], b, a)
                for a, b in zip(self.maps, new.maps, strict=True)
            )
        )

    def projections(self) -> list[Tensor]:
        """What the fusions of the tokenizer add, [(B·N, C, h, w), …], cameras as rows of the batch."""
        return [each.flatten(0, 1) for each in self.maps[1:]]


NO_CONTEXT: Final = Context()
