"""How good the text model's goal frames are: near to a true final frame, and is the task done in them?"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.statistics import Estimate, Proportion
from lerobot_wmrl.world_models.evaluation.image_metrics import psnr
from lerobot_wmrl.world_models.evaluation.replay import Source
from lerobot_wmrl.world_models.evaluation.success_probe import TrainedProbe, is_held_out
from lerobot_wmrl.world_models.frame_cache import frames_to_tensor
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel

MOST_GOALS = 64
MOST_FINALS = 200


@dataclass(frozen=True)
class Goals:
    """G goal frames and F true final frames, decoded.

    episodes (G,) of the starts; start, goal: decoded frames; reached (G,), whether θ was reached;
    finals: of successful episodes, final_starts: their first frames; final_episodes (F,); nearest (G,): the final of the same instruction with the least feature
    distance to the goal, −1 without one; distance, start_distance (G,): to the goal, to the start frame.
    """

    episodes: np.ndarray
    start: Tensor
    goal: Tensor
    reached: np.ndarray
    final_episodes: np.ndarray
    finals: Tensor
    final_starts: Tensor
    nearest: np.ndarray
    distance: np.ndarray
    start_distance: np.ndarray


@torch.no_grad()
def imagine_goals(model: TextWorldModelRewardModel, source: Source, episodes: np.ndarray) -> Goals:
    """Imagine a goal from the start of each of at most `MOST_GOALS` episodes and look for its like."""
    table, device, tokenizer = source.table, model.state_mean.device, model.tokenizer
    starts = episodes[:MOST_GOALS]
    tokens = tokenizer.encode(source.first_images(starts, device))
    instructions = [table.instructions[episode] for episode in starts]
    goal = imagine_goal(model, tokens, source.first_state(starts, device), instructions)
    finals, rows = final_rows(source)
    final = decoded_frames(tokenizer, source.frames[rows], device)
    same = np.array([[table.instructions[f] == text for f in finals] for text in instructions])
    same = same.reshape(len(starts), len(finals))
    start = tokenizer.decode_with_features(tokens)
    distance = feature_distances(goal.features, final.features, tokenizer.num_cameras)
    start_distance = feature_distances(start.features, final.features, tokenizer.num_cameras)
    closest, nearest = least(distance, same)
    return Goals(
        starts, start.images, tokenizer.decode(goal.tokens), goal.reached.cpu().numpy(),
        finals, final.images, decoded_frames(tokenizer, source.frames[table.start[finals]], device).images,
        nearest, closest, least(start_distance, same)[0],
    )  # fmt: skip


def goal_quality(goals: Goals, probe: TrainedProbe | None) -> dict[str, Any]:
    """Distances to the nearest true final frame, those of the start frame, and the probe's verdict."""
    known = goals.nearest >= 0
    result = {
        "goals": len(goals.episodes),
        "goal_reached": Proportion(int(goals.reached.sum()), len(goals.reached)).as_json(),
        "nearest_final_tokenizer_lpips": Estimate.mean(goals.distance).as_json(),
        "start_to_final_tokenizer_lpips": Estimate.mean(goals.start_distance).as_json(),
        "nearest_final_psnr": Estimate.mean(
            psnr(goals.goal[known], goals.finals[goals.nearest[known]]).cpu().numpy()
        ).as_json(),
    }
    if probe is not None:
        unseen = is_held_out(goals.final_episodes)
        result["success_holds"] = probe.success(goals.start, goals.goal).as_json()
        result["success_holds_in_finals"] = probe.success(
            goals.final_starts[unseen], goals.finals[unseen]
        ).as_json()
        result["probe"] = probe.as_json()
    return result


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


def decoded_frames(tokenizer: FrameTokenizer, frames: np.ndarray, device: torch.device) -> Decoded:
    """uint8 (F, N, H, W, 3) as the tokenizer draws them, with their features."""
    return tokenizer.decode_with_features(tokenizer.encode(frames_to_tensor(frames).to(device)))


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
    if not distance.shape[1]:
        return np.full(len(distance), np.nan), np.full(len(distance), -1)
    masked = np.where(allowed, distance, np.inf)
    index, some = masked.argmin(1), allowed.any(1)
    return np.where(some, masked.min(1), np.nan), np.where(some, index, -1)
