"""What a frame attends to along time: its clip in training, a ring of past frames in imagination.

Each memory's `attend` takes one layer's query, key and value (B, S, h, T, d) of new frames and returns what
they attend to, of the same shape.
"""

from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor

from lerobot_wmrl.world_models.attention import Rotation, attention, attention_with_own


class TemporalMemory(Protocol):
    """Attention along time, layer by layer."""

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """(B, S, h, T, d) each → (B, S, h, T, d)."""


class FrameCache(Protocol):
    """What a network remembers of the imaginations that it steps."""

    @property
    def dtype(self) -> torch.dtype:
        """What the network computes in."""

    @property
    def numbers(self) -> int:
        """That it holds."""

    def restart(self, mask: Tensor) -> None:
        """The next frame of the environments in `mask` (B,) is their first."""

    def begin_before(self, other: Self, frames: int) -> None:
        """Be empty, and so many frames behind the `other` cache, of the same window."""

    def put(self, rows: Tensor, other: Self) -> None:
        """Remember in `rows` (R,) what the other cache does, of R environments at the same frame."""


def banded_causal_mask(length: int, window: int, device: torch.device) -> Tensor:
    """True where frame q may see frame k: q − window < k ≤ q. → (T, T)."""
    index = torch.arange(length, device=device)
    lag = index[:, None] - index[None, :]
    return (lag >= 0) & (lag < window)


@dataclass
class DraftMemory:
    """Frames that others do not see: a draft sees what the frame before it saw, and itself.

    past: keys and values (B, S, h, K, d) by layer; mask broadcastable to (B, S, h, T, K).
    """

    past: dict[int, tuple[Tensor, Tensor]]
    mask: Tensor
    rotation: Rotation

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        query, key = self.rotation(query), self.rotation(key)
        return attention_with_own(query, key, value, self.past[layer], self.mask)


class ClipMemory:
    """Training: frame t of a whole clip sees frames t − window + 1 … t."""

    def __init__(self, length: int, window: int, head_width: int, device: torch.device) -> None:
        self.positions, self.head_width = torch.arange(length, device=device), head_width
        self.rotation = Rotation.at(self.positions, head_width)
        self.mask = banded_causal_mask(length, window, device)
        self.past: dict[int, tuple[Tensor, Tensor]] = {}

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        query, key = self.rotation(query), self.rotation(key)
        self.past[layer] = key, value
        return attention(query, key, value, self.mask)

    def drafts(self) -> DraftMemory:
        """For a draft of each frame's next one, once every layer has been attended to."""
        return DraftMemory(self.past, self.mask, Rotation.at(self.positions + 1, self.head_width))


@dataclass
class TemporalCache:
    """Keys and values of the last `window` frames of every environment, a ring over time.

    keys, values: (L, B, S, h, window, d). `position` (1,) is the number of frames begun so far,
    `started` (B,) the position of each environment's first frame: older slots are masked. Where to write
    and what to mask are tensors, so that a step can be captured in a CUDA graph; `visible` is the number of
    slots looked at, known to the host: those that are filled if it `grows`, else all.
    """

    keys: Tensor
    values: Tensor
    started: Tensor
    position: Tensor
    visible: int
    grows: bool

    @classmethod
    def empty(
        cls, shape: tuple[int, ...], device: torch.device, dtype: torch.dtype, grows: bool
    ) -> "TemporalCache":
        """A ring of shape (L, B, S, h, window, d)."""
        keys, values = (torch.zeros(shape, device=device, dtype=dtype) for _ in range(2))
        started, position = (torch.zeros(n, dtype=torch.long, device=device) for n in (shape[1], 1))
        return cls(keys, values, started, position, 0 if grows else shape[-2], grows)

    @property
    def dtype(self) -> torch.dtype:
        """What the network computes in."""
        return self.keys.dtype

    @property
    def numbers(self) -> int:
        """That it holds, keys and values."""
        return 2 * self.keys.numel()

    @property
    def window(self) -> int:
        return self.keys.shape[-2]

    def advance(self) -> "RingMemory":
        """Begin a frame, in the oldest one's slot."""
        slot = self.position % self.window
        self.position += 1
        if self.grows:
            self.visible = min(self.visible + 1, self.window)
        return RingMemory(self, slot, self._mask(), Rotation.at(self.position - 1, self.keys.shape[-1]))

    def restart(self, mask: Tensor) -> None:
        """The next frame of the environments in `mask` (B,) is their first: the past is masked, not moved."""
        self.started.copy_(torch.where(mask, self.position, self.started))

    def begin_before(self, other: "TemporalCache", frames: int) -> None:
        """Slots and rotations will be those of the other's frames. ValueError if it has not had so many."""
        if not frames < min(self.window, int(other.position) + 1):
            raise ValueError(
                f"a past of {frames} frames, of a world model that remembers {self.window} and imaginations "
                f"that are {int(other.position)} frames old: it must be shorter than both"
            )
        self.position.copy_(other.position - frames)
        self.started.copy_(self.position.expand_as(self.started))
        self.visible = other.visible

    def put(self, rows: Tensor, other: "TemporalCache") -> None:
        """Keys, values, and when the rows started."""
        for ring, theirs in ((self.keys, other.keys), (self.values, other.values)):
            ring.index_copy_(1, rows, theirs)
        self.started.index_copy_(0, rows, other.started)

    def past(self, layer: int) -> tuple[Tensor, Tensor]:
        """Keys and values of the visible slots, (B, S, h, visible, d)."""
        return self.keys[layer, ..., : self.visible, :], self.values[layer, ..., : self.visible, :]

    def drafts(self) -> DraftMemory:
        """For drafts of the frame after the newest one."""
        past = {layer: self.past(layer) for layer in range(len(self.keys))}
        return DraftMemory(past, self._mask(), Rotation.at(self.position, self.keys.shape[-1]))

    def _mask(self) -> Tensor:
        """Which visible slots hold frames of the current episode. → (B, 1, 1, 1, visible)"""
        newest = self.position - 1
        slots = torch.arange(self.visible, device=self.started.device)
        held = newest - (newest - slots) % self.window
        return (held >= self.started[:, None])[:, None, None, None]


@dataclass
class RingMemory:
    """Imagination: one new frame (T = 1) writes its keys and values into the ring and sees what is there."""

    cache: TemporalCache
    slot: Tensor
    mask: Tensor
    rotation: Rotation

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        for ring, new in ((self.cache.keys, self.rotation(key)), (self.cache.values, value)):
            ring[layer].index_copy_(-2, self.slot, new.to(ring.dtype))
        return attention(self.rotation(query), *self.cache.past(layer), self.mask)
