"""First frames, states, instructions and goals from which imagined episodes begin."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.constants import TASKS
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.rewards.similarity import Description, Similarity
from lerobot_wmrl.world_models.compatibility import check_dataset
from lerobot_wmrl.world_models.context import Context
from lerobot_wmrl.world_models.depth_maps import depth_at
from lerobot_wmrl.world_models.episode_table import (
    EpisodeTable,
    choose_episodes,
    open_dataset,
    read_episodes,
)
from lerobot_wmrl.world_models.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)

GOAL_BATCH = 64


class Starts(NamedTuple):
    """K starts: tokens (K, S), the images they decode to (K, N, 3, H, W), the tokenizer's context of K first
    frames, proprioception (K, P), depth (K, S) in metres if the model looks at it, instructions."""

    tokens: Tensor
    images: Tensor
    context: Context
    proprioception: Tensor
    depth: Tensor | None
    instructions: list[str]


class Goals(NamedTuple):
    """Of K starts: what the goal frame is compared by [(K·N, …)] and how, the start's similarity to it (K,),
    and reached (K,), False where the text model never reached θ."""

    described: Description
    alike: Similarity
    similarity: Tensor
    reached: Tensor


def chosen_episodes(table: EpisodeTable, source: StartFrames) -> np.ndarray:
    """Episodes to begin like, of the split, tasks and scenes asked for. (K,) ValueError if there is none."""
    unseen = {scene.index for scene in scenes_of("ood")}
    wanted = np.ones(len(table.start), bool)
    for name, column, values in (
        ("tasks", table.task, [TASKS.index(task) for task in source.tasks or ()]),
        ("scenes", table.scene, source.scenes or ()),
    ):
        if values and not np.isin(column, values).any():
            raise ValueError(
                f"--env.dataset.{name}={getattr(source, name)}: no episode of {source.root} has one of them"
            )
        wanted &= np.isin(column, values) if values else True
    return choose_episodes(table, source.split, source.max_starts, unseen, wanted)


def tasks_of_starts(source: StartFrames) -> list[int]:
    """Indices of the tasks among the chosen episodes, empty if the dataset does not say."""
    table = read_episodes(open_dataset(source.root, source.repo_id))
    tasks = table.task[chosen_episodes(table, source)]
    return np.unique(tasks[tasks >= 0]).tolist()


@torch.no_grad()
def load_starts(
    source: StartFrames, model: ActionWorldModelRewardModel, text_model: TextWorldModelRewardModel | None,
    alike: Similarity,
) -> tuple[Starts, Goals | None]:  # fmt: skip
    """Read the starts and, with a text model, imagine each one's goal frame once (eq. 6)."""
    table = read_episodes(open_dataset(source.root, source.repo_id))
    check_dataset(model.config, table.dataset.features)
    episodes = chosen_episodes(table, source)
    rows, device = table.start[episodes], model.state_mean.device
    images = frames_to_tensor(cached_frames(table.dataset, model.config.camera_keys)[rows]).to(device)
    state = torch.from_numpy(table.state[rows]).to(device)
    context = model.tokenizer.context(images)
    tokens = model.tokenizer.encode(images, context)
    decoded = model.tokenizer.decode_with_features(tokens, context)
    starts = Starts(
        tokens,
        decoded.images,
        context,
        state[:, : model.config.state_size],
        depth_at(model, table.dataset, rows),
        [table.instructions[episode] for episode in episodes],
    )
    if text_model is None:
        return starts, None
    check_dataset(text_model.config, table.dataset.features)
    depth = depth_at(text_model, table.dataset, rows)
    return starts, imagine_goals(text_model, starts, alike.describe(decoded), alike, state, depth)


@torch.no_grad()
def imagine_goals(
    model: TextWorldModelRewardModel, starts: Starts, described: Description, alike: Similarity,
    state: Tensor, depth: Tensor | None,
) -> Goals:  # fmt: skip
    """Goal frames of all starts, which are so `described`; state (K, P) as the dataset has it."""
    goals = [
        imagine_goal(
            model, starts.tokens[part], state[part], starts.instructions[part], starts.context[part],
            depth if depth is None else depth[part],
        )
        for part in (slice(i, i + GOAL_BATCH) for i in range(0, len(state), GOAL_BATCH))
    ]  # fmt: skip
    parts = zip(*(alike.describe(goal.decoded) for goal in goals), strict=True)
    wanted = [torch.cat(part) for part in parts]
    reached = torch.cat([goal.reached for goal in goals])
    return Goals(wanted, alike, alike(described, wanted, model.tokenizer.num_cameras), reached)
