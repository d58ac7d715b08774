"""Imagination that begins amid an episode: the frames before are looked at, not imagined."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.imagination import ImaginationState


@dataclass(frozen=True)
class Frames:
    """Of B imaginations: tokens (B, S), state (B, P) in the dataset's units, and, where the model looks at
    it, depth (B, S) in metres."""

    tokens: Tensor
    proprioception: Tensor
    depth: Tensor | None

    def __getitem__(self, rows: Any) -> "Frames":
        depth = self.depth if self.depth is None else self.depth[rows]
        return Frames(self.tokens[rows], self.proprioception[rows], depth)


@dataclass(frozen=True)
class Past:
    """The H frames before those with which B imaginations begin, oldest first, each with its action (B, A) in
    the dataset's units."""

    frames: tuple[Frames, ...] = ()
    actions: tuple[Tensor, ...] = ()

    def __getitem__(self, rows: Any) -> "Past":
        return Past(
            tuple(frame[rows] for frame in self.frames), tuple(action[rows] for action in self.actions)
        )


@torch.no_grad()
def start_after(
    model: Any, past: Past, now: Frames, context: Context = NO_CONTEXT, dtype: torch.dtype | None = None
) -> ImaginationState:
    """`Imagination.start` at the frames `now`, in a model that remembers the `past`; the context is that of
    where the past begins."""
    state = _begin(model, (*past.frames, now)[0], context, dtype)
    _remember(model, state, past, now)
    return state


@torch.no_grad()
def restart_after(
    model: Any, state: ImaginationState, mask: Tensor, past: Past, now: Frames, context: Context = NO_CONTEXT
) -> None:
    """`Imagination.restart` of the environments in `mask` (B,), as `start_after` would begin them: they are
    begun apart, as many frames ago as they have a past, and take their places when they are as far as the
    others. Arguments are of all B."""
    if not past.frames:
        model.restart(state, mask, now.tokens, now.proprioception, now.depth, context)
        return
    rows = mask.nonzero().squeeze(1)
    apart = _begin(model, past.frames[0][rows], context[rows], state.cache.dtype)
    apart.cache.begin_before(state.cache, len(past.frames))
    _remember(model, apart, past[rows], now[rows])
    model.see(state, mask, now.tokens, now.proprioception, now.depth)
    state.context = state.context.replaced(mask, context)
    state.cache.put(rows, apart.cache)


def _begin(model: Any, first: Frames, context: Context, dtype: torch.dtype | None) -> ImaginationState:
    state: ImaginationState = model.start(
        first.tokens, first.proprioception, dtype=dtype, depth=first.depth, context=context
    )
    return state


def _remember(model: Any, state: ImaginationState, past: Past, now: Frames) -> None:
    """Put `state`, which is at the first of the frames, at the last; what the model expects of them is of no
    interest."""
    everyone = torch.ones(len(now.tokens), dtype=torch.bool, device=now.tokens.device)
    unused = torch.Generator(now.tokens.device)
    for action, after in zip(past.actions, (*past.frames, now)[1:], strict=True):
        model.step(state, action, unused)
        model.see(state, everyone, after.tokens, after.proprioception, after.depth)
