"""First frames, states, instructions and goals from which imagined episodes begin."""

from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.world_models.compatibility import check_dataset
from lerobot_wmrl.world_models.context import Context
from lerobot_wmrl.world_models.depth_maps import depth_at
from lerobot_wmrl.world_models.episode_table import choose_episodes, open_dataset, read_episodes
from lerobot_wmrl.world_models.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.world_models.goal import imagine_goal, similarity
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)

GOAL_BATCH = 64


class Starts(NamedTuple):
    """K starts: tokens (K, S), the images they decode to (K, N, 3, H, W), the tokenizer's context of K first
    frames, proprioception (K, P), depth (K, S) in metres if the model looks at it, instructions, goal
    features [(K·N, C, h, w)], the start's similarity to its goal (K,), and goal_reached (K,), False where the
    text model never reached θ."""

    tokens: Tensor
    images: Tensor
    context: Context
    proprioception: Tensor
    depth: Tensor | None
    instructions: list[str]
    goal_features: list[Tensor]
    similarity: Tensor
    goal_reached: Tensor


@torch.no_grad()
def load_starts(
    source: StartFrames, model: ActionWorldModelRewardModel, text_model: TextWorldModelRewardModel
) -> Starts:
    """Read the starts and imagine each one's goal frame once (eq. 6)."""
    table = read_episodes(open_dataset(source.root, source.repo_id))
    for config in (model.config, text_model.config):
        check_dataset(config, table.dataset.features)
    episodes = choose_episodes(table, source.split, source.max_starts)
    rows = table.start[episodes]
    instructions = [table.instructions[episode] for episode in episodes]
    device = model.state_mean.device
    images = frames_to_tensor(cached_frames(table.dataset, model.config.camera_keys)[rows]).to(device)
    state = torch.from_numpy(table.state[rows]).to(device)
    context, depth = model.tokenizer.context(images), depth_at(model, table.dataset, rows)
    tokens = model.tokenizer.encode(images, context)
    goals = [
        imagine_goal(
            text_model,
            tokens[i : i + GOAL_BATCH],
            state[i : i + GOAL_BATCH],
            instructions[i : i + GOAL_BATCH],
            context[i : i + GOAL_BATCH],
            depth_at(text_model, table.dataset, rows[i : i + GOAL_BATCH]),
        )
        for i in range(0, len(rows), GOAL_BATCH)
    ]
    goal_features = [torch.cat(layers) for layers in zip(*(goal.features for goal in goals), strict=True)]
    decoded = model.tokenizer.decode_with_features(tokens, context)
    closeness = similarity(decoded.features, goal_features, len(tokens))
    reached = torch.cat([goal.reached for goal in goals])
    return Starts(
        tokens,
        decoded.images,
        context,
        state[:, : model.config.state_size],
        depth,
        instructions,
        goal_features,
        closeness,
        reached,
    )
