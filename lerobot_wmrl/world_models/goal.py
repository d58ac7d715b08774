"""Goal frames (eq. 6) and the similarity to them (eq. 5)."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.data.frames import NO_CONTEXT, Context, Frames
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.imagination import ImaginationMixin

GOAL_THRESHOLD: Final = 0.5
"""θ of eq. 6, the done probability at which a frame becomes the goal frame."""


class Goal(NamedTuple):
    """Goal frames: tokens (B, S); the frames decoded; reached (B,), False where θ was never reached."""

    tokens: Tensor
    decoded: Decoded
    reached: Tensor


@torch.no_grad()
def imagine_goal(model: ImaginationMixin, frames: Frames, instructions: Sequence[str]) -> Goal:
    """Imagine the goal frame (eq. 6): the first whose done probability reaches θ (`GOAL_THRESHOLD`), else the
    likeliest.

    Args:
        model: a text world model; imagines `goal_horizon` frames at most.
        frames: where the imaginations begin.
        instructions: one for each.
    """
    imagination, tokens = model.start(frames, instructions), frames.tokens
    goal, best = tokens, torch.full((tokens.shape[0],), -1.0, device=tokens.device)
    reached = torch.zeros_like(best, dtype=torch.bool)
    for _ in range(model.config.goal_horizon):
        imagined = model.step(imagination)
        probability = imagined.done_logit.sigmoid()
        better = (probability > best) & ~reached
        goal = torch.where(better[:, None], imagined.tokens, goal)
        best = torch.where(better, probability, best)
        reached = reached | (probability >= GOAL_THRESHOLD)
        if bool(reached.all()):
            break
    return Goal(goal, model.tokenizer.decode_with_features(goal, frames.context), reached)


def similarity_to_goal(
    tokenizer: FrameTokenizer, tokens: Tensor, goal_features: Sequence[Tensor], context: Context = NO_CONTEXT
) -> Tensor:
    """Eq. 5 with 1 − LPIPS's formula on tokenizer features: tokens (B, S) → similarity in [0, 1] (B,)."""
    features = tokenizer.decode_with_features(tokens, context).features
    return similarity_from_distance(feature_distance(features, goal_features), tokens.shape[0])


def similarity_from_distance(distance: Tensor, batch: int) -> Tensor:
    """1 − distance of each camera's frame (B·N,), averaged over its cameras, in [0, 1]. → (B,)"""
    return (1 - distance.unflatten(0, (batch, -1)).mean(1)).clamp(0, 1)


def select_features(features: Sequence[Tensor], rows: Tensor, cameras: int) -> list[Tensor]:
    """Return the features of some of K frames: [(K·N, …)], rows (B,) → [(B·N, …)]"""
    return [part.unflatten(0, (-1, cameras))[rows].flatten(0, 1) for part in features]
