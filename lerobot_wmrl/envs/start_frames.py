"""First frames, states, instructions and goals from which imagined episodes begin."""

from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.envs.first_frames import FirstFrames
from lerobot_wmrl.rewards.similarity import Description, Similarity
from lerobot_wmrl.world_models.context import Context
from lerobot_wmrl.world_models.frame_cache import frames_to_tensor
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


@torch.no_grad()
def load_starts(
    frames: FirstFrames, model: ActionWorldModelRewardModel, text_model: TextWorldModelRewardModel | None,
    alike: Similarity,
) -> tuple[Starts, Goals | None]:  # fmt: skip
    """Tokenise first frames and, with a text model, imagine each one's goal frame once (eq. 6)."""
    device = model.state_mean.device
    images, state = frames_to_tensor(frames.images).to(device), torch.from_numpy(frames.state).to(device)
    context = model.tokenizer.context(images)
    tokens = model.tokenizer.encode(images, context)
    decoded = model.tokenizer.decode_with_features(tokens, context)
    starts = Starts(
        tokens,
        decoded.images,
        context,
        state[:, : model.config.state_size],
        frames.depth(model),
        frames.instructions,
    )
    if text_model is None:
        return starts, None
    return starts, imagine_goals(
        text_model, starts, alike.describe(decoded), alike, state, frames.depth(text_model)
    )


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
