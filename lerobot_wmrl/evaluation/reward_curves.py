"""The general reward along recorded episodes: what a policy would have been paid for them, frame by frame."""

from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.images import to_pixels
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.evaluation.replay import EpisodeReplay, Recording
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import general_reward, potential_discount
from lerobot_wmrl.rewards.similarity import Similarity, make_similarity
from lerobot_wmrl.world_models.frame_tokenizer import Decoded
from lerobot_wmrl.world_models.goal import imagine_goal, select_features
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel

PART: Final = 64
"""Frames that are compared with the goal at a time: features of a long episode would not fit into memory."""


@torch.no_grad()
def reward_along_episode(
    text_model: TextWorldModelRewardModel,
    reward: GeneralConfig,
    recording: Recording,
    replay: EpisodeReplay,
    *,
    criterion: SuccessCriterion,
    longest: int,
) -> dict[str, Any]:
    """Compute eqs. 5-8 for an episode: the similarity of recorded frames, and the success of imagined ones.

    Args:
        replay: the same episode, imagined with its own actions.
        criterion: what counts as a predicted success.
        longest: frames after which the environment ends an episode, which decide its discount.

    Returns:
        Lists over the frames after the first (done_probability, similarity, return), the imagined goal_frame
        and the recorded final_frame (N, H, W, 3) uint8, and goal_reached.
    """
    table, rows = recording.table, recording.rows(replay.episode)
    first = recording.starts(text_model, np.array([replay.episode]))
    goal = imagine_goal(text_model, first, [table.instructions[replay.episode]])
    frames, measure = recording.frames[rows], make_similarity(reward.similarity, first.tokens.device)
    similarity = similarity_to_goal(text_model, measure, first, goal.decoded, frames)
    probability = replay.done_probability[:-1]
    earned = general_reward(
        paid_once(probability, criterion),
        similarity[1:],
        similarity[:-1],
        alpha=reward.success_weight,
        form=reward.form,
        gamma=potential_discount(reward, longest),
    )
    return {
        "done_probability": probability.tolist(),
        "similarity": similarity[1:].tolist(),
        "return": earned.cumsum(0).tolist(),
        "goal_reached": bool(goal.reached[0]),
        "goal_frame": to_pixels(goal.decoded.images[0]),
        "final_frame": np.asarray(frames[-1]),
    }


def similarity_to_goal(
    text_model: TextWorldModelRewardModel, measure: Similarity, first: Frames, goal: Decoded, frames: Any
) -> Tensor:
    """Return how similar recorded frames, uint8 (T, N, H, W, 3), are to the imagined goal of their episode.
    → (T,)"""
    tokenizer, device = text_model.tokenizer, first.tokens.device
    goal_features = measure.features(goal)

    def of(part: Tensor) -> Tensor:
        context = first.context[[0] * len(part)]
        decoded = tokenizer.decode_with_features(tokenizer.encode(part, context), context)
        every = torch.zeros(len(part), dtype=torch.long, device=device)
        wanted = select_features(goal_features, every, tokenizer.num_cameras)
        return measure(measure.features(decoded), wanted, tokenizer.num_cameras)

    parts = (frames[at : at + PART] for at in range(0, len(frames), PART))
    return torch.cat([of(frames_to_tensor(part).to(device)) for part in parts])


def paid_once(probability: Tensor, criterion: SuccessCriterion) -> Tensor:
    """Return 1 for the frame at which an episode has met the criterion, 0 for the others. (T,) → (T,)"""
    paid = torch.zeros_like(probability)
    (begin,) = criterion.first_met(probability.cpu().numpy()[None])
    if begin >= 0:
        paid[begin + criterion.frames - 1] = 1
    return paid
