"""What the anchored network keeps of a first frame, and what it knows of the past since."""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.world_models.path import Path
from lerobot_wmrl.world_models.temporal_memory import RingMemory, TemporalCache


class Scene(NamedTuple):
    """First frames of B clips, seen once: digits (B, 1, S, C), transformer tokens (B, 1, 1 + S', D), what
    these offer each of the trajectory's L layers (B, 1, L, 2, h, 1 + S', d), places (B, 1, D), local features
    (B, N, code_width, g, g)."""

    digits: Tensor
    tokens: Tensor
    offered: Tensor
    places: Tensor
    local: Tensor


def put_rows[T: tuple[Tensor, ...]](old: T, rows: Tensor, new: T) -> T:
    """`old` with `new` in the rows `rows` (R,) of every tensor."""
    replaced = (a.index_copy(0, rows, b.to(a.dtype)) for a, b in zip(old, new, strict=True))
    return type(old)(*replaced)


@dataclass
class AnchoredCache:
    """Imaginations that each began at a frame of their own: its scene, the path since, a ring of the past.

    Whoever has imagined as many frames as the ring holds begins anew at the frame that was imagined last.
    `frame` is the ring's position, known to the host, and `beginnings` are the frames, modulo the ring's
    window, at which somebody may have begun: at any other the device need not be asked who is due.
    """

    ring: TemporalCache
    scene: Scene | None = None
    path: Path | None = None
    frame: int = 0
    beginnings: set[int] = field(default_factory=lambda: {0})

    @property
    def dtype(self) -> torch.dtype:
        """What the network computes in."""
        return self.ring.dtype

    @property
    def numbers(self) -> int:
        """That it holds: the ring's, the scenes' and the paths'."""
        held = [*(self.scene or ()), *(self.path or ())]
        return self.ring.numbers + sum(tensor.numel() for tensor in held)

    def restart(self, mask: Tensor) -> None:
        """The next frame of the environments in `mask` (B,) is their first."""
        self.beginnings.add(self._phase)
        self.ring.restart(mask)

    def begin_before(self, other: "AnchoredCache", frames: int) -> None:
        """Be empty, and so many frames behind the other cache."""
        self.ring.begin_before(other.ring, frames)
        self.frame = other.frame - frames
        self.beginnings = {self._phase}

    def put(self, rows: Tensor, other: "AnchoredCache") -> None:
        """Remember in `rows` (R,) what the other cache does."""
        assert other.scene is not None
        assert other.path is not None
        self.begin(rows, other.scene, other.path)
        self.ring.put(rows, other.ring)
        self.beginnings |= other.beginnings

    def due(self) -> Tensor:
        """Environments that have to begin now: rows (R,). Waits for the device to say which, if there may be
        any."""
        if self._phase not in self.beginnings:
            return self.ring.started.new_empty(0)
        age = self.ring.position - self.ring.started
        rows = (age % self.ring.window == 0).nonzero().squeeze(1)
        if not len(rows):
            self.beginnings.remove(self._phase)
        return rows

    def begin(self, rows: Tensor, scene: Scene, path: Path) -> None:
        """Rows (R,) begin at scenes and paths of R rows."""
        started = self.ring.started.index_copy(0, rows, self.ring.position.expand(len(rows)))
        self.ring.started.copy_(started)
        if self.scene is None or self.path is None:
            self.scene, self.path = scene, path
            return
        self.scene, self.path = put_rows(self.scene, rows, scene), put_rows(self.path, rows, path)

    def advance(self) -> RingMemory:
        """Begin a frame in the ring."""
        self.frame += 1
        return self.ring.advance()

    @property
    def _phase(self) -> int:
        return self.frame % self.ring.window
