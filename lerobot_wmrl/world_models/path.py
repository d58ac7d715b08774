"""Where a robot gets to: its states after each of a clip's actions, from the first state and the scene.

Contact bends paths, and a robot that is told how far to go from where it is never makes up for that. So this
network goes step by step: it is given where it has got to by its own account, and what stands where. Training
goes through all of its steps, so nothing differs between training and imagination.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.world_models.frame_network import STATE_STEP

PLACE_CHANNELS = 16
"""That each of the scene's tokens contributes to what is known of places."""


class Path(NamedTuple):
    """States after T actions and what else is remembered of them.

    state (B, T, P) in normalised units, change (B, T, P) of the last step in `STATE_STEP`s, hidden (B, T, D).
    """

    state: Tensor
    change: Tensor
    hidden: Tensor

    def end(self) -> "Path":
        """Where it goes on, T = 1."""
        return Path(*(tensor[:, -1:] for tensor in self))


class Places(nn.Module):
    """A scene's M tokens to one vector. Each has weights of its own: where things are is what matters."""

    def __init__(self, tokens: int, width: int) -> None:
        super().__init__()
        self.channels = nn.Linear(width, PLACE_CHANNELS)
        self.mix = nn.Linear(tokens * PLACE_CHANNELS, width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, M, D) → (B, T, D)"""
        flat = F.silu(self.channels(tokens)).flatten(2)
        return self.out(F.silu(self.mix(flat)))


class PathNetwork(nn.Module):
    """A recurrent network whose outputs are summed to the state. Computes in float32."""

    def __init__(self, state_size: int, width: int) -> None:
        super().__init__()
        self.start = nn.Linear(state_size, width)
        self.given = nn.Linear(2 * width, width)
        self.moved = nn.Linear(2 * state_size, width)
        self.mix = nn.Linear(width, width)
        self.cell = nn.GRUCell(width, width)
        self.pull = nn.Linear(width, state_size)
        self.carry = nn.Linear(state_size, state_size, bias=False)
        nn.init.zeros_(self.carry.weight)
        self.push = nn.Linear(width, state_size)

    def begin(self, state: Tensor) -> Path:
        """In a clip's first state (B, 1, P), with no past."""
        with compute_in(torch.float32, state.device):
            return Path(state, torch.zeros_like(state), self.start(state).tanh())

    def forward(self, begin: Path, places: Tensor, condition: Tensor) -> Path:
        """T steps further under the conditions' means (B, T, D) among what stands at `places` (B, 1, D)."""
        with compute_in(torch.float32, condition.device):
            condition = condition.float()
            given = self.given(torch.cat([condition, places.float().expand_as(condition)], -1))
            steps, now = [], Path(*(tensor[:, 0] for tensor in begin))
            for known, pull in zip(given.unbind(1), self.pull(condition).unbind(1), strict=True):
                now = self._step(now, known, pull)
                steps.append(now)
            return Path(*(torch.stack(tensors, 1) for tensors in zip(*steps, strict=True)))

    def _step(self, now: Path, given: Tensor, pull: Tensor) -> Path:
        """One action further, all tensors without a time."""
        seen = F.silu(given + self.moved(torch.cat([now.state, now.change], -1)))
        hidden = self.cell(F.silu(self.mix(seen)), now.hidden)
        change = pull + self.carry(now.change) + self.push(hidden)
        return Path(now.state + STATE_STEP * change, change, hidden)
