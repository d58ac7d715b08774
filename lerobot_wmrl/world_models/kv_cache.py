"""The KV cache of imagination: keys and values of past frames in a preallocated ring."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_wmrl.world_models.layers import Rotation, attention


@dataclass
class KVCache:
    """Keys and values of the last `window` frames of every environment, a ring over time.

    keys, values: (L, B, S, h, window, d). `position` (1,) is the number of frames begun so far,
    `started` (B,) the position of each environment's first frame: older slots are masked. Where to write
    and what to mask are tensors, so that a step can be captured in a CUDA graph; `visible` is the number of
    slots that attention looks at, known to the host: those that are filled if it `grows`, else all.
    """

    keys: Tensor
    values: Tensor
    started: Tensor
    position: Tensor
    visible: int
    grows: bool

    @classmethod
    def empty(
        cls, shape: tuple[int, ...], device: torch.device, dtype: torch.dtype, grows: bool | None = None
    ) -> "KVCache":
        """Return a ring of shape (L, B, S, h, window, d).

        If it grows, attention skips slots that are still empty; if not, all steps have the same shapes, which
        a CUDA graph needs. By default it grows on the CPU.
        """
        grows = device.type == "cpu" if grows is None else grows
        keys, values = (torch.zeros(shape, device=device, dtype=dtype) for _ in range(2))
        started, position = (torch.zeros(n, dtype=torch.long, device=device) for n in (shape[1], 1))
        return cls(keys, values, started, position, 0 if grows else shape[-2], grows)

    @property
    def dtype(self) -> torch.dtype:
        """Number format in which the network computes."""
        return self.keys.dtype

    @property
    def window(self) -> int:
        """Frames that it holds at most."""
        return self.keys.shape[-2]

    def advance(self) -> "CachedMemory":
        """Begin a frame, in the oldest one's slot."""
        slot = self.position % self.window
        self.position += 1
        if self.grows:
            self.visible = min(self.visible + 1, self.window)
        return CachedMemory(self, slot, self.mask(), Rotation.at(self.position - 1, self.keys.shape[-1]))

    def restart(self, mask: Tensor) -> None:
        """Begin anew in the environments in `mask` (B,): their past is masked, not moved."""
        self.started.copy_(torch.where(mask, self.position, self.started))

    def past(self, layer: int) -> tuple[Tensor, Tensor]:
        """Keys and values of the visible slots, (B, S, h, visible, d)."""
        return self.keys[layer, ..., : self.visible, :], self.values[layer, ..., : self.visible, :]

    def mask(self) -> Tensor:
        """Mark the visible slots that hold frames of the current imagination. → (B, 1, 1, 1, visible)"""
        newest = self.position - 1
        slots = torch.arange(self.visible, device=self.started.device)
        held = newest - (newest - slots) % self.window
        return (held >= self.started[:, None])[:, None, None, None]


@dataclass
class CachedMemory:
    """One new frame (T = 1) writes its keys and values into the ring and sees what is there."""

    cache: KVCache
    slot: Tensor
    mask: Tensor
    rotation: Rotation

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attention along time, as in `TemporalMemory`."""
        for ring, new in ((self.cache.keys, self.rotation(key)), (self.cache.values, value)):
            ring[layer].index_copy_(-2, self.slot, new.to(ring.dtype))
        return attention(self.rotation(query), *self.cache.past(layer), self.mask)
