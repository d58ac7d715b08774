"""How good the text model's goal frames are: near to a true final frame, and is the task done in them?"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.statistics import Estimate, Proportion
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.evaluation.image_metrics import psnr
from lerobot_wmrl.evaluation.replay import Source
from lerobot_wmrl.evaluation.success_probe import TrainedProbe, is_held_out
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel

MOST_GOALS = 64
MOST_FINALS = 200


class Finals(NamedTuple):
    """True final frames: F successful episodes (F,), where success begins in them and how they began, both
    decoded (F, N, 3, H, W), and the features of the former."""

    episodes: np.ndarray
    images: Tensor
    starts: Tensor
    features: list[Tensor]


@dataclass(frozen=True)
class Goals:
    """G goal frames beside true final frames; pictures are decoded, (G, N, 3, H, W) in [0, 1].

    episodes (G,), whose starts they are; start, goal; reached (G,), whether θ was reached; finals, None
    without a success; nearest (G,): of the finals with the same instruction the one with the least feature
    distance to the goal, −1 without one; distance, start_distance (G,): least ones to the goal, to the start.
    """

    episodes: np.ndarray
    start: Tensor
    goal: Tensor
    reached: np.ndarray
    finals: Finals | None
    nearest: np.ndarray
    distance: np.ndarray
    start_distance: np.ndarray


@torch.no_grad()
def imagine_goals(model: TextWorldModelRewardModel, source: Source, episodes: np.ndarray) -> Goals:
    """Imagine a goal from the start of each of at most `MOST_GOALS` episodes and look for its like."""
    table, device, tokenizer = source.table, model.state_mean.device, model.tokenizer
    starts = episodes[:MOST_GOALS]
    tokens, context = source.starts(starts, tokenizer)
    instructions = [table.instructions[episode] for episode in starts]
    state, depth = source.first_state(starts, device), source.first_depth(model, starts)
    goal = imagine_goal(model, tokens, state, instructions, context, depth)
    start, finals = tokenizer.decode_with_features(tokens, context), true_finals(tokenizer, source, device)
    nearest, distance = np.full(len(starts), -1), np.full(len(starts), np.nan)
    start_distance = distance
    if finals is not None:
        same = np.array([[table.instructions[f] == text for f in finals.episodes] for text in instructions])
        pairs = feature_distances(goal.decoded.features, finals.features, tokenizer.num_cameras)
        distance, nearest = least(pairs, same)
        pairs = feature_distances(start.features, finals.features, tokenizer.num_cameras)
        start_distance = least(pairs, same)[0]
    return Goals(
        starts, start.images, goal.decoded.images, goal.reached.cpu().numpy(), finals,
        nearest, distance, start_distance,
    )  # fmt: skip


def goal_quality(goals: Goals, probe: TrainedProbe | None) -> dict[str, Any]:
    """Distances to the nearest true final frame, those of the start frame, and the probe's verdict."""
    result = {
        "goals": len(goals.episodes),
        "goal_reached": Proportion(int(goals.reached.sum()), len(goals.reached)).as_json(),
        "nearest_final_tokenizer_lpips": Estimate.mean(goals.distance).as_json(),
        "start_to_final_tokenizer_lpips": Estimate.mean(goals.start_distance).as_json(),
        "nearest_final_psnr": Estimate.mean(nearest_psnr(goals)).as_json(),
    }
    if probe is not None and goals.finals is not None:
        unseen = is_held_out(goals.finals.episodes)
        result["success_holds"] = probe.success(goals.start, goals.goal).as_json()
        result["success_holds_in_finals"] = probe.success(
            goals.finals.starts[unseen], goals.finals.images[unseen]
        ).as_json()
        result["probe"] = probe.as_json()
    return result


def nearest_psnr(goals: Goals) -> np.ndarray:
    """dB between each goal and the final nearest to it, of those that have one."""
    if goals.finals is None:
        return np.empty(0)
    known = goals.nearest >= 0
    return psnr(goals.goal[known], goals.finals.images[goals.nearest[known]]).cpu().numpy()


def true_finals(tokenizer: FrameTokenizer, source: Source, device: torch.device) -> Finals | None:
    """None if no episode succeeds."""
    episodes, rows = final_rows(source)
    if not len(episodes):
        return None
    first, context = source.starts(episodes, tokenizer)
    images = frames_to_tensor(source.frames[rows]).to(device)
    tokens = first, tokenizer.encode(images, context)
    starts, decoded = (tokenizer.decode_with_features(each, context) for each in tokens)
    return Finals(episodes, decoded.images, starts.images, decoded.features)


def final_rows(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """At most `MOST_FINALS` successful episodes and the rows of their first frames in which success holds."""
    table = source.table
    episodes = table.success.nonzero()[0]
    episodes = episodes[np.linspace(0, len(episodes) - 1, min(len(episodes), MOST_FINALS)).astype(int)]
    rows = [
        start + min(int(table.done[start : start + n].argmax()) + 1, n - 1)
        for start, n in zip(table.start[episodes], table.length[episodes], strict=True)
    ]
    return episodes, np.array(rows, int)


def feature_distances(goals: Sequence[Tensor], finals: Sequence[Tensor], num_cameras: int) -> np.ndarray:
    """LPIPS's formula on tokenizer features for every pair, over N cameras: [(G·N, C, h, w)] and
    [(F·N, C, h, w)] → (G, F)."""
    count = len(finals[0]) // num_cameras
    rows = []
    for goal in zip(*(layer.split(num_cameras) for layer in goals), strict=True):
        spread = [layer.repeat(count, 1, 1, 1) for layer in goal]
        rows.append(feature_distance(spread, finals).unflatten(0, (count, num_cameras)).mean(1))
    return torch.stack(rows).cpu().numpy()


def least(distance: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the allowed columns the least value of each row and its index; NaN and −1 where none is. (G, F)"""
    masked = np.where(allowed, distance, np.inf)
    index, some = masked.argmin(1), allowed.any(1)
    return np.where(some, masked.min(1), np.nan), np.where(some, index, -1)
