"""Where a robot gets to: its states after each of a clip's actions, from the first state and the actions.

No predicted state is fed back, so nothing differs between training and imagination.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lerobot_wmrl.precision import compute_in
from lerobot_wmrl.world_models.frame_network import STATE_STEP


class Path(NamedTuple):
    """States after T actions and what else is remembered of them.

    state (B, T, P) in normalised units, hidden (B, T, D).
    """

    state: Tensor
    hidden: Tensor

    def end(self) -> "Path":
        """Where it goes on, T = 1."""
        return Path(self.state[:, -1:], self.hidden[:, -1:])


class PathNetwork(nn.Module):
    """A recurrent network over the conditions; its outputs are summed to the state. Computes in float32."""

    def __init__(self, state_size: int, width: int) -> None:
        super().__init__()
        self.start = nn.Linear(state_size, width)
        self.recurrence = nn.GRU(width, width, batch_first=True)
        self.change = nn.Linear(width, state_size)

    def begin(self, state: Tensor) -> Path:
        """At a clip's first state (B, 1, P)."""
        with compute_in(torch.float32, state.device):
            return Path(state, self.start(state).tanh())

    def forward(self, begin: Path, condition: Tensor) -> Path:
        """T steps further under the conditions' means (B, T, D)."""
        with compute_in(torch.float32, condition.device):
            first = begin.hidden.transpose(0, 1).contiguous()
            hidden, _ = self.recurrence(condition.float(), first)
            return Path(begin.state + STATE_STEP * self.change(hidden).cumsum(1), hidden)
