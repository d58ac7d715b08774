"""Imaginations with anchored dynamics: where each began, and when it begins anew."""

from dataclasses import dataclass, field

from torch import Tensor

from lerobot_wmrl.world_models.anchored.network import EncodedScene, StateRollout
from lerobot_wmrl.world_models.dynamics import Imagination
from lerobot_wmrl.world_models.kv_cache import CachedMemory


@dataclass
class AnchoredImagination(Imagination):
    """Imaginations that each began at a frame of their own: its scene, and the state rollout since.

    An environment that has imagined as many frames as the cache holds begins anew at its last frame.

    `frame` is the cache's position, known to the host. `phases` are the values of `frame`, modulo the cache's
    window, at which some environment may have to begin. At all others the host need not wait for the device.
    """

    scene: EncodedScene | None = None
    rollout: StateRollout | None = None
    frame: int = 0
    phases: set[int] = field(default_factory=lambda: {0})

    def restart(self, mask: Tensor) -> None:
        self.phases.add(self._phase)
        super().restart(mask)

    def due(self) -> Tensor:
        """Return the environments that have to begin now, rows (R,).

        The host waits for the device only if there may be any.
        """
        if self._phase not in self.phases:
            return self.cache.started.new_empty(0)
        age = self.cache.position - self.cache.started
        rows = (age % self.cache.window == 0).nonzero().squeeze(1)
        if not len(rows):
            self.phases.remove(self._phase)
        return rows

    def begin(self, rows: Tensor, scene: EncodedScene, rollout: StateRollout) -> None:
        """Begin in the environments `rows` (R,) with scenes and state rollouts of R rows."""
        cache = self.cache
        cache.started.copy_(cache.started.index_copy(0, rows, cache.position.expand(len(rows))))
        if self.scene is None or self.rollout is None:
            self.scene, self.rollout = scene, rollout
        else:
            self.scene = put_rows(self.scene, rows, scene)
            self.rollout = put_rows(self.rollout, rows, rollout)

    def advance(self) -> CachedMemory:
        """Begin a frame in the cache."""
        self.frame += 1
        return self.cache.advance()

    @property
    def _phase(self) -> int:
        return self.frame % self.cache.window


def put_rows[T: tuple[Tensor, ...]](old: T, rows: Tensor, new: T) -> T:
    """Return `old` with `new` in the rows `rows` (R,) of every tensor."""
    replaced = (a.index_copy(0, rows, b.to(a.dtype)) for a, b in zip(old, new, strict=True))
    return type(old)(*replaced)
