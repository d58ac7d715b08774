"""Starts of imagined episodes as the world model reads them: tokenised frames, and the goal frame of each.

K is the number of starts, N the number of cameras.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import Context, Frames
from lerobot_wmrl.envs.start_frames import StartImages
from lerobot_wmrl.rewards.similarity import Features, Similarity
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)

STARTS_AT_ONCE = 64
"""Starts that are tokenised, and goal frames that are imagined, at once."""


class Starts(NamedTuple):
    """K starts, tokenised: their frames, with the context of their episodes' first frames, the images
    (K, N, 3, H, W) that these decode to, K instructions, and how their episodes began
    (`StartImages.origins`)."""

    frames: Frames
    images: Tensor
    instructions: list[str]
    origins: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.instructions)


class GoalFeatures(NamedTuple):
    """Goal frames of K starts: their features [(K·N, …)] and the measure that compares them, the similarity
    of each start to its goal (K,), and reached (K,), False where the text model never reached θ."""

    features: Features
    measure: Similarity
    similarity: Tensor
    reached: Tensor


@torch.no_grad()
def load_starts(
    frames: StartImages,
    model: ActionWorldModelRewardModel,
    text_model: TextWorldModelRewardModel | None,
    measure: Similarity,
) -> tuple[Starts, GoalFeatures | None]:
    """Tokenise the starts and, with a text model, imagine each one's goal frame once (eq. 6)."""
    device = model.device
    state = torch.from_numpy(frames.state).to(device)
    tokens, images, contexts, features = [], [], [], []
    for part in in_parts(len(state)):
        first, shown = (frames_to_tensor(of[part]).to(device) for of in (frames.first_images, frames.images))
        contexts.append(model.tokenizer.context(first))
        tokens.append(model.tokenizer.encode(shown, contexts[-1]))
        decoded = model.tokenizer.decode_with_features(tokens[-1], contexts[-1])
        images.append(decoded.images)
        if text_model is not None:
            features.append(measure.features(decoded))
    begin = Frames(torch.cat(tokens), state, Context.joined(contexts))
    start_frames = replace(
        begin,
        state=state[:, : model.config.state_size],
        depth=frames.depth(model),
        instruction_weights=model.instruction_weights(frames.instructions, len(state)),
    )
    starts = Starts(start_frames, torch.cat(images), frames.instructions, frames.origins)
    if text_model is None:
        return starts, None
    begin = replace(begin, depth=frames.depth(text_model))
    goals = imagine_goal_features(text_model, begin, frames.instructions, joined(features), measure)
    return starts, goals


def in_parts(count: int) -> list[slice]:
    """Cut `count` starts into parts of at most `STARTS_AT_ONCE`."""
    return [slice(begin, begin + STARTS_AT_ONCE) for begin in range(0, count, STARTS_AT_ONCE)]


def joined(parts: Sequence[Features]) -> Features:
    """Put the features of several parts together."""
    return [torch.cat(each) for each in zip(*parts, strict=True)]


@torch.no_grad()
def imagine_goal_features(
    model: TextWorldModelRewardModel,
    frames: Frames,
    instructions: list[str],
    features: Features,
    measure: Similarity,
) -> GoalFeatures:
    """Imagine the goal frame of every start.

    Args:
        frames: the first frames of the K starts, as the text model is given them.
        instructions: one for each.
        features: features of the first frames, as `measure` computes them, [(K·N, …)].
    """
    goals = [imagine_goal(model, frames[part], instructions[part]) for part in in_parts(len(frames))]
    goal_features = joined([measure.features(goal.decoded) for goal in goals])
    similarity = measure(features, goal_features, model.tokenizer.num_cameras)
    return GoalFeatures(goal_features, measure, similarity, torch.cat([goal.reached for goal in goals]))
