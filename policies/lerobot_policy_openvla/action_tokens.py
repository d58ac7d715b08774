"""Actions as tokens: 256 bins over [-1, 1], written with the last 256 ids of the tokenizer's vocabulary."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

BINS: Final = 256
EDGES: Final = np.linspace(-1, 1, BINS)
"""NumPy's, float64: torch's differ in the last bit, and an action on an edge would change its bin."""


@dataclass(frozen=True)
class ActionTokenizer:
    """`vocabulary`: ids of the tokenizer, 32000 in the release, whose action tokens are 31744 … 31999."""

    vocabulary: int

    @property
    def first_id(self) -> int:
        """The lowest of the 256 ids. It stands for the largest actions."""
        return self.vocabulary - BINS

    def encode(self, actions: Tensor) -> Tensor:
        """Normalised actions, clipped to [-1, 1] → ids of their bins: −1 is the last id, 1 the first."""
        edges = torch.from_numpy(EDGES).to(actions.device)
        return self.vocabulary - torch.bucketize(actions.double().clamp(-1, 1), edges, right=True)

    def decode(self, ids: Tensor) -> Tensor:
        """Ids → the centres of their bins, float32. The first two ids share one; ids outside are clipped."""
        centres = torch.from_numpy((EDGES[:-1] + EDGES[1:]) / 2).to(ids.device)
        return centres[(self.vocabulary - 1 - ids).clamp(0, BINS - 2)].float()

    def columns(self, ids: Tensor) -> Tensor:
        """Ids → their places 0 … 255 among the action tokens. ValueError if one is none."""
        columns = ids - self.first_id
        outside = (columns < 0) | (columns >= BINS)
        if bool(outside.any()):
            raise ValueError(
                f"token id {ids[outside][0].item()} is no action: labels must be from {self.first_id} to "
                f"{self.vocabulary - 1}"
            )
        return columns
