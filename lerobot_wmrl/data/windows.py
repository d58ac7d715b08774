"""Windows as lerobot-train gives them, to clips as world models learn from them."""

from collections.abc import Mapping
from typing import Any

import torch
from lerobot.utils.constants import ACTION, DONE, OBS_STATE
from torch import Tensor

from lerobot_wmrl.data.clip import Clip, take_rows


def clip_from_windows(
    tokens: Tensor, batch: Mapping[str, Any], camera_key: str, state_size: int, depth: Tensor | None = None
) -> Clip:
    """A window ends at its row of the dataset; a clip begins at a frame that has no past.

    LeRobot fills a window that would begin before its episode with copies of the first row. They are moved
    behind the window's end, where they count for nothing: else the model would learn that actions at the
    start of an episode do nothing. Only the last row's `next.done` is in the batch, and like the token path
    (`--model.from_start`) only windows that hold their episode's start have it as a label.

    Args:
        tokens: (B, T, S), of the window's frames.
        batch: action (B, T, A), observation.state (B, T, P), either (B, T) where it has one component;
            next.done (B,) or (B, 1), task, `*_is_pad` (B, T); all but the action may be missing.
        depth: (B, T, S) metres, of the window's frames.

    Raises:
        ValueError: the action is missing or has another length than the frames; NaN or infinity in a number.
    """
    (rows, length), device = tokens.shape[:2], tokens.device
    action = batch.get(ACTION)
    if action is not None and action.shape == (rows, length):
        action = action[..., None]
    if action is None or action.ndim != 3 or action.shape[1] != length:
        found = "none" if action is None else f"shape {tuple(action.shape)}"
        raise ValueError(f"action: {found}, but the batch has windows of {length} frames; give one a frame")
    state = action.new_zeros(rows, length, 0)
    if state_size:
        state = batch[OBS_STATE].reshape(rows, length, -1)
    for name, values in ((ACTION, action), (OBS_STATE, state)):
        if not torch.isfinite(values).all():
            raise ValueError(f"{name}: holds NaN or infinity; remove the episodes that do from the dataset")
    padded = batch.get(f"{camera_key}_is_pad", torch.zeros(rows, length, dtype=torch.bool)).to(device)
    before, index = padded.sum(1, keepdim=True), unpadded_rows(padded)
    valid = torch.arange(length, device=device) < length - before
    last = torch.arange(length, device=device) == length - 1 - before
    done, known = torch.zeros(rows, length, device=device), torch.zeros_like(last)
    if isinstance(batch.get(DONE), Tensor):  # LeRobot's processors put False where the dataset has none
        done, known = last * batch[DONE].reshape(rows, 1).float(), last & (before > 0)
    tokens, state, action = (take_rows(values, index) for values in (tokens, state, action))
    depth = depth if depth is None else take_rows(depth, index)
    return Clip(tokens, state, action, done, valid, known, list(batch.get("task", [""] * rows)), depth)


def unpadded_rows(padded: Tensor) -> Tensor:
    """Where to take a clip's rows from in windows of which the first rows are padding. (B, T) → (B, T)"""
    length = padded.shape[1]
    return (torch.arange(length, device=padded.device) + padded.sum(1, keepdim=True)).clamp(max=length - 1)
