"""Goal frames of the text world model: their distance to recorded final frames, and whether success holds in
them (`success_probe.py`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.statistics import Estimate, Proportion, evenly_spaced
from lerobot_wmrl.data.frame_cache import frames_to_tensor
from lerobot_wmrl.evaluation.image_metrics import psnr
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.evaluation.success_probe import TrainedProbe, held_out_from_probe
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.goal import imagine_goal
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel

MAX_FINALS = 200


class Finals(NamedTuple):
    """Recorded final frames of F successful episodes.

    Attributes:
        episodes: their indices (F,).
        images: the frames in which success begins, decoded (F, N, 3, H, W).
        starts: the first frames of those episodes, decoded (F, N, 3, H, W).
        features: decoder features of `images`.
    """

    episodes: np.ndarray
    images: Tensor
    starts: Tensor
    features: list[Tensor]


@dataclass(frozen=True)
class Goals:
    """Goal frames of G episodes beside recorded final frames; images are decoded, (G, N, 3, H, W) in [0, 1].

    Args:
        episodes: the episodes (G,) from whose first frames the goals are imagined.
        start, goal: the first frames and the goal frames.
        reached: whether the done threshold was reached, (G,).
        finals: recorded final frames, None without a success.
        nearest: index into `finals` of the nearest one with the same instruction by feature distance, −1
            without one, (G,).
        distance, start_distance: least feature distance of the goal and of the start, (G,).
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
def imagine_goals(model: TextWorldModelRewardModel, recording: Recording, episodes: np.ndarray) -> Goals:
    """Imagine goals from the first frames of episodes (G,) and find the nearest finals."""
    tokenizer = model.tokenizer
    frames = recording.starts(model, episodes)
    instructions = [recording.table.instructions[episode] for episode in episodes]
    goal = imagine_goal(model, frames, instructions)
    start = tokenizer.decode_with_features(frames.tokens, frames.context)
    finals = final_frames(tokenizer, recording)
    nearest, distance = np.full(len(episodes), -1), np.full(len(episodes), np.nan)
    start_distance = distance
    if finals is not None:
        same = np.array(
            [[recording.table.instructions[f] == text for f in finals.episodes] for text in instructions]
        )
        pairs = feature_distances(goal.decoded.features, finals.features, tokenizer.num_cameras)
        distance, nearest = least(pairs, same)
        pairs = feature_distances(start.features, finals.features, tokenizer.num_cameras)
        start_distance = least(pairs, same)[0]
    return Goals(
        episodes,
        start.images,
        goal.decoded.images,
        goal.reached.cpu().numpy(),
        finals,
        nearest,
        distance,
        start_distance,
    )


class GoalQuality(NamedTuple):
    """How good goal frames are.

    Attributes:
        goal_reached: goals that reach the done threshold.
        nearest_final_tokenizer_lpips, start_to_final_tokenizer_lpips: distance of the goals, and of the
            starts, to the nearest recorded final frame.
        nearest_final_psnr: PSNR (dB) of goals and the final frame nearest to them.
        success_holds, success_holds_in_finals: goals, and finals that `probe` has not seen, in which it says
            that success holds; None without a probe.
        probe: the success probe.
    """

    goal_reached: Proportion
    nearest_final_tokenizer_lpips: Estimate
    start_to_final_tokenizer_lpips: Estimate
    nearest_final_psnr: Estimate
    success_holds: Proportion | None = None
    success_holds_in_finals: Proportion | None = None
    probe: TrainedProbe | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the measures as JSON, without those of a probe that there is not."""
        measures = {name: each.as_json() for name, each in self._asdict().items() if each is not None}
        return {"goals": self.goal_reached.n, **measures}


def goal_quality(goals: Goals, probe: TrainedProbe | None) -> GoalQuality:
    """Measure the distances of goals and starts to the nearest finals, and the probe's share of successes."""
    quality = GoalQuality(
        Proportion.of(goals.reached),
        Estimate.mean(goals.distance),
        Estimate.mean(goals.start_distance),
        Estimate.mean(nearest_psnr(goals)),
    )
    if probe is None or goals.finals is None:
        return quality
    unseen = held_out_from_probe(goals.finals.episodes)
    in_finals = probe.success(goals.finals.starts[unseen], goals.finals.images[unseen])
    in_goals = probe.success(goals.start, goals.goal)
    return quality._replace(success_holds=in_goals, success_holds_in_finals=in_finals, probe=probe)


def nearest_psnr(goals: Goals) -> np.ndarray:
    """PSNR in dB between each goal and the final nearest to it, for the goals that have one."""
    if goals.finals is None:
        return np.empty(0)
    known = goals.nearest >= 0
    return psnr(goals.goal[known], goals.finals.images[goals.nearest[known]]).cpu().numpy()


def final_frames(tokenizer: FrameTokenizer, recording: Recording) -> Finals | None:
    """Decode the recorded final frames, None if no episode succeeds."""
    episodes, rows = final_rows(recording)
    if not len(episodes):
        return None
    first, context = recording.first_frames(episodes, tokenizer)
    images = frames_to_tensor(recording.frames[rows]).to(first.device)
    tokens = first, tokenizer.encode(images, context)
    starts, decoded = (tokenizer.decode_with_features(each, context) for each in tokens)
    return Finals(episodes, decoded.images, starts.images, decoded.features)


def final_rows(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `MAX_FINALS` successful episodes and the rows of their first frames with success."""
    table = recording.table
    episodes = (table.success & recording.readable).nonzero()[0]
    episodes = episodes[evenly_spaced(len(episodes), MAX_FINALS)]
    rows = [
        min(each.start + int(table.done[each].argmax()) + 1, each.stop - 1) for each in table.rows(episodes)
    ]
    return episodes, np.array(rows, int)


def feature_distances(goals: Sequence[Tensor], finals: Sequence[Tensor], num_cameras: int) -> np.ndarray:
    """LPIPS's formula on tokenizer features for every pair, averaged over N cameras.

    [(G·N, C, h, w)] and [(F·N, C, h, w)] → (G, F).
    """
    count = len(finals[0]) // num_cameras
    rows = []
    for goal in zip(*(layer.split(num_cameras) for layer in goals), strict=True):
        spread = [layer.repeat(count, 1, 1, 1) for layer in goal]
        rows.append(feature_distance(spread, finals).unflatten(0, (count, num_cameras)).mean(1))
    return torch.stack(rows).cpu().numpy()


def least(distance: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each row's least allowed value and its column; NaN and −1 where none is allowed. (G, F)"""
    masked = np.where(allowed, distance, np.inf)
    index, some = masked.argmin(1), allowed.any(1)
    return np.where(some, masked.min(1), np.nan), np.where(some, index, -1)
