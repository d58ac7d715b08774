"""Clips: what world models learn from and are asked about."""

from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.data.frames import NO_CONTEXT, Context


class Clip(NamedTuple):
    """Rows t = 0 … T − 1 of an episode: what is seen, what is done, and what that leads to.

    tokens (B, T, S); state (B, T, P) in dataset units; action (B, T, A); done (B, T), success at frame
    t + 1; valid (B, T), False where the episode is padded; done_known (B, T); one instruction an episode;
    depth (B, T, S), metres of each token, and the context of the episode's first frame, for models that look
    at them.
    """

    tokens: Tensor
    state: Tensor
    action: Tensor
    done: Tensor
    valid: Tensor
    done_known: Tensor
    instructions: list[str]
    depth: Tensor | None = None
    context: Context = NO_CONTEXT


def take_rows(values: Tensor, index: Tensor) -> Tensor:
    """Rows `index` (B, K) of every clip: values (B, T, …) → (B, K, …)."""
    return values[torch.arange(len(values), device=values.device)[:, None], index]


def known_transitions(valid: Tensor) -> Tensor:
    """Where a valid frame follows a valid one: (B, T) → (B, T − 1)."""
    return valid[:, 1:] & valid[:, :-1]
