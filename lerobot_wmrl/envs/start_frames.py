"""First frames, states, instructions and goals from which imagined episodes begin."""

from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.envs.first_frames import FirstFrames
from lerobot_wmrl.rewards.similarity import Description, Similarity
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)
from lerobot_wmrl.world_models.past import Frames, Past

GOAL_BATCH = 64


class Starts(NamedTuple):
    """K starts: frames, the images they decode to (K, N, 3, H, W), the frames before, the tokenizer's context
    of the earliest, instructions."""

    now: Frames
    images: Tensor
    past: Past
    context: Context
    instructions: list[str]

    def __len__(self) -> int:
        return len(self.instructions)


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
    state, actions = (torch.from_numpy(each).to(device) for each in (frames.state, frames.actions))
    context = model.tokenizer.context(frames_to_tensor(frames.images[:, 0]).to(device))
    depth, seen = frames.depth(model), []
    for row in range(state.shape[1]):
        images = frames_to_tensor(frames.images[:, row]).to(device)
        known = None if depth is None else depth[:, row]
        tokens = model.tokenizer.encode(images, context)
        seen.append(Frames(tokens, state[:, row, : model.config.state_size], known))
    *before, now = seen
    decoded = model.tokenizer.decode_with_features(now.tokens, context)
    past = Past(tuple(before), actions.unbind(1))
    starts = Starts(now, decoded.images, past, context, frames.instructions)
    if text_model is None:
        return starts, None
    depth = frames.depth(text_model)
    last = depth if depth is None else depth[:, -1]
    return starts, imagine_goals(text_model, starts, alike.describe(decoded), alike, state[:, -1], last)


@torch.no_grad()
def imagine_goals(
    model: TextWorldModelRewardModel, starts: Starts, described: Description, alike: Similarity,
    state: Tensor, depth: Tensor | None,
) -> Goals:  # fmt: skip
    """Goal frames of all starts, which are so `described`; state (K, P) as the dataset has it."""
    goals = [
        imagine_goal(
            model, starts.now.tokens[part], state[part], starts.instructions[part], starts.context[part],
            depth if depth is None else depth[part],
        )
        for part in (slice(i, i + GOAL_BATCH) for i in range(0, len(state), GOAL_BATCH))
    ]  # fmt: skip
    parts = zip(*(alike.describe(goal.decoded) for goal in goals), strict=True)
    wanted = [torch.cat(part) for part in parts]
    reached = torch.cat([goal.reached for goal in goals])
    return Goals(wanted, alike, alike(described, wanted, model.tokenizer.num_cameras), reached)
