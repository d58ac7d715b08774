"""Goal frames (eq. 6) and the similarity to them (eq. 5)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer, feature_distance

if TYPE_CHECKING:
    from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel


class Goal(NamedTuple):
    """tokens (B, S); the decoded frame; reached (B,), False where θ was never reached."""

    tokens: Tensor
    decoded: Decoded
    reached: Tensor


@torch.no_grad()
def imagine_goal(
    model: "TextWorldModelRewardModel",
    tokens: Tensor,
    proprioception: Tensor,
    instructions: Sequence[str],
    context: Context = NO_CONTEXT,
    depth: Tensor | None = None,
) -> Goal:
    """Eq. 6: the first imagined frame whose done probability reaches θ, else the one of the largest.

    tokens (B, S) of the start frames, proprioception (B, P), one instruction each, the start frames' context
    if the tokenizer is conditioned on it, and their depth (B, S) in metres if the model looks at it.
    """
    state = model.start(tokens, proprioception, instructions, depth=depth, context=context)
    goal, best = tokens, torch.full((tokens.shape[0],), -1.0, device=tokens.device)
    reached = torch.zeros_like(best, dtype=torch.bool)
    for _ in range(model.config.goal_horizon):
        imagined = model.step(state)
        probability = imagined.done_logit.sigmoid()
        better = (probability > best) & ~reached
        goal = torch.where(better[:, None], imagined.tokens, goal)
        best = torch.where(better, probability, best)
        reached = reached | (probability >= model.config.goal_threshold)
        if bool(reached.all()):
            break
    return Goal(goal, model.tokenizer.decode_with_features(goal, context), reached)


def similarity_to_goal(
    tokenizer: FrameTokenizer, tokens: Tensor, goal_features: Sequence[Tensor], context: Context = NO_CONTEXT
) -> Tensor:
    """Eq. 5 with 1 − LPIPS's formula on tokenizer features: tokens (B, S) → similarity in [0, 1] (B,)."""
    features = tokenizer.decode_with_features(tokens, context).features
    return similarity_from_distance(feature_distance(features, goal_features), tokens.shape[0])


def similarity_from_distance(distance: Tensor, batch: int) -> Tensor:
    """1 − distance of each camera's frame (B·N,), averaged over its cameras, in [0, 1]. → (B,)"""
    return (1 - distance.unflatten(0, (batch, -1)).mean(1)).clamp(0, 1)
