"""The general reward along recorded episodes: what a policy would have been paid for them, frame by frame."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.images import to_bytes
from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import consecutive_count, general_reward, is_done, potential_discount
from lerobot_wmrl.rewards.similarity import make_similarity
from lerobot_wmrl.world_models.goal import imagine_goal, select_features
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)


@torch.no_grad()
def reward_along_episode(
    model: ActionWorldModelRewardModel, text_model: TextWorldModelRewardModel, reward: GeneralConfig,
    recording: Recording, episode: int, *, threshold: float, frames: int,
) -> dict[str, Any]:  # fmt: skip
    """Compute eqs. 5-8 on the recorded frames of one episode, teacher-forced.

    Args:
        threshold: done probability that counts as done.
        frames: consecutive frames for which it must be reached.

    Returns:
        Lists over the frames after the first (done_probability, similarity, return), the imagined goal_frame
        and the recorded final_frame (N, H, W, 3) uint8, and goal_reached.
    """
    table, device = recording.table, model.state_mean.device
    rows = slice(table.start[episode], table.start[episode] + table.length[episode])
    images = frames_to_tensor(recording.frames[rows]).to(device)
    start = model.tokenizer.context(images[:1])
    context = start[[0] * len(images)]
    tokens = model.tokenizer.encode(images, context)
    state, action = (torch.from_numpy(column[rows]).to(device) for column in (table.state, table.action))
    known = torch.ones(1, len(tokens), dtype=torch.bool, device=device)
    instruction = [table.instructions[episode]]
    depth = model.recorded_depth(table.dataset, np.arange(rows.start, rows.stop)[None])
    clip = Clip(
        tokens[None], state[None], action[None], known.float(), known, known, instruction, depth, start
    )
    done_logit = model.predict(clip, with_tokens=False).done_logit[0, :-1]
    first_depth = text_model.recorded_depth(table.dataset, slice(rows.start, rows.start + 1))
    goal = imagine_goal(text_model, Frames(tokens[:1], state[:1], start, first_depth), instruction)
    measure, cameras = make_similarity(reward.similarity, device), model.tokenizer.num_cameras
    features = measure.features(model.tokenizer.decode_with_features(tokens, context))
    every = torch.zeros(len(tokens), dtype=torch.long, device=device)
    goal_features = select_features(measure.features(goal.decoded), every, cameras)
    similarity = measure(features, goal_features, cameras)
    paid = success_once(done_logit, threshold, frames)
    earned = general_reward(
        paid, similarity[1:], similarity[:-1],
        alpha=reward.alpha, form=reward.form, gamma=potential_discount(reward, int(table.length.max())),
    )  # fmt: skip
    picture = goal.decoded.images[0].permute(0, 2, 3, 1)
    return {
        "done_probability": done_logit.sigmoid().tolist(),
        "similarity": similarity[1:].tolist(),
        "return": earned.cumsum(0).tolist(),
        "goal_reached": bool(goal.reached[0]),
        "goal_frame": to_bytes(picture).cpu().numpy(),
        "final_frame": np.asarray(recording.frames[rows][-1]),
    }


def success_once(done_logit: Tensor, threshold: float, frames: int) -> Tensor:
    """Return 1 on the frame that completes the first run of `frames` done frames, else 0. (T,) → (T,)"""
    count, paid = done_logit.new_zeros((), dtype=torch.long), torch.zeros_like(done_logit)
    for step, logit in enumerate(done_logit):
        count = consecutive_count(count, is_done(logit, threshold))
        if count >= frames:
            paid[step] = 1
            break
    return paid
