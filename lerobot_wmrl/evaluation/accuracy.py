"""Accuracy of an open-loop replay: imagined against recorded frames by step, and under extreme actions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.statistics import Estimate, Proportion, bootstrap_ratio, evenly_spaced
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.embodiment import POSITION_NAMES, component_names
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.evaluation.image_metrics import (
    PerceptualDistance,
    depth_accuracy,
    masked_psnr,
    motion_mask,
    physics_iq,
    psnr,
    ssim,
)
from lerobot_wmrl.evaluation.replay import (
    BATCH,
    DELTA_PSNR_SECONDS,
    EpisodeReplay,
    Recording,
    imagine_frames,
)
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

HORIZON_SECONDS = 1.92
"""Imagined time over which accuracy is averaged: 48 frames at 25 a second."""

CEILING_SECONDS = 1.2
"""Imagined time after which a frame is compared with the tokenizer's reconstruction, the best it could be."""

ABSOLUTE = 0.8
"""Correlation with the state from which actions are taken for absolute targets, not for displacements."""


@dataclass(frozen=True)
class EpisodeAccuracy:
    """Measures of one episode: `steps`, (T − 1,) values an imagined frame; `whole`, one value an episode."""

    episode: int
    steps: dict[str, np.ndarray]
    whole: dict[str, float]


@torch.no_grad()
def measure(
    model: ActionWorldModelRewardModel,
    recording: Recording,
    replay: EpisodeReplay,
    lpips: PerceptualDistance | None,
) -> EpisodeAccuracy:
    """Compare the imagined frames of one episode with the recorded ones."""
    images = recording.images(replay.episode, replay.tokens.device)
    if len(images) < 2:
        return EpisodeAccuracy(replay.episode, {}, {})
    imagined, horizon = replay.tokens[: len(images) - 1], recording.steps(HORIZON_SECONDS)
    steps, whole = compare_frames(model.tokenizer, images, imagined, replay.context, lpips, horizon)
    if predicts_tcp(recording, replay):
        steps["tcp_error_mm"] = tcp_error_mm(recording, replay)
    if replay.depth is not None:
        steps |= depth_accuracy(imagined=replay.depth[1], recorded=replay.depth[0])
    step = recording.steps(DELTA_PSNR_SECONDS)
    if replay.shuffled is not None and len(steps["psnr"]) >= step:
        target = images[step : step + 1]
        other = psnr(model.tokenizer.decode(replay.shuffled[None], replay.context), target)
        whole["delta_psnr_0_6s"] = float(steps["psnr"][step - 1] - other)
    if len(steps["psnr"]) >= (step := recording.steps(CEILING_SECONDS)):
        score, best = (float(steps[name][step - 1]) for name in ("psnr", "psnr_ceiling"))
        whole |= {"psnr_1_2s": score, "psnr_ceiling_1_2s": best, "psnr_below_ceiling_1_2s": best - score}
    return EpisodeAccuracy(
        replay.episode, {name: value.cpu().numpy() for name, value in steps.items()}, whole
    )


def compare_frames(
    tokenizer: FrameTokenizer,
    images: Tensor,
    imagined_tokens: Tensor,
    context: Context,
    lpips: PerceptualDistance | None,
    horizon: int,
) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Compare imagined with recorded frames, and with their reconstruction by the tokenizer, the ceiling.

    Args:
        images: recorded frames (T + 1, N, 3, H, W).
        imagined_tokens: (T, S), of all frames but the first.
        context: context of the first frame, one row.
        lpips: LPIPS, None to leave it out.
        horizon: frames over which the measures of the episode are taken.

    Returns:
        Measures of every frame, each (T,), and measures of the episode.
    """
    first, recorded = images[:1], images[1:]
    tokens = tokenizer.encode(images, context[[0] * len(images)])
    contexts = context[[0] * len(recorded)]
    ceiling, imagined = (tokenizer.decode_with_features(t, contexts) for t in (tokens[1:], imagined_tokens))
    moved = motion_mask(recorded, first)
    distance = feature_distance(imagined.features, ceiling.features)
    steps = {
        "psnr": psnr(imagined.images, recorded),
        "psnr_ceiling": psnr(ceiling.images, recorded),
        "moving_psnr": masked_psnr(imagined.images, recorded, moved),
        "moving_psnr_ceiling": masked_psnr(ceiling.images, recorded, moved),
        "ssim": ssim(imagined.images, recorded),
        "tokenizer_lpips": distance.unflatten(0, (len(recorded), -1)).mean(1),
        "token_accuracy": (imagined_tokens == tokens[1:]).float().mean(1),
    }
    if lpips is not None:
        steps["lpips_alex"] = lpips(imagined.images, recorded)
    moved_imagined = motion_mask(imagined.images, tokenizer.decode(tokens[:1], context))
    whole = physics_iq(moved[:horizon], moved_imagined[:horizon])
    whole["mse"] = float((imagined.images[:horizon] - recorded[:horizon]).square().mean())
    return steps, whole


def predicts_tcp(recording: Recording, replay: EpisodeReplay) -> bool:
    """Whether the model predicts a state that begins with the TCP's position in metres."""
    if not replay.state.shape[-1]:
        return False
    return tuple(component_names(recording.table.dataset.features[OBS_STATE])[:3]) == POSITION_NAMES


def tcp_error_mm(recording: Recording, replay: EpisodeReplay) -> Tensor:
    """Distance of the imagined from the recorded TCP in millimetres, (T − 1,)."""
    recorded = torch.from_numpy(recording.table.state[recording.compared_rows(replay.episode)][1:, :3])
    return 1000 * (replay.state[:-1, :3].cpu() - recorded).norm(dim=-1)


def by_step(measured: Sequence[EpisodeAccuracy], horizon: int) -> dict[str, Any]:
    """Average each measure step by step over the episodes that last so long, up to `horizon` steps.

    Returns:
        `<name>_by_step`; `bands[name]` = [low, high], the pointwise bootstrap 95 % band;
        `episodes_by_step`, the number of episodes behind each step.
    """
    shown = [each for each in measured if each.steps]
    result: dict[str, Any] = {"bands": {}}
    for name in dict.fromkeys(name for each in shown for name in each.steps):
        values = stacked([each.steps[name] for each in shown], horizon)
        known = np.isfinite(values)
        mean, low, high = bootstrap_ratio(np.where(known, values, 0), known)
        result[f"{name}_by_step"] = json_list(mean)
        result["bands"][name] = [json_list(low), json_list(high)]
    lasting = np.isfinite(stacked([each.steps["psnr"] for each in shown], horizon)).sum(0)
    return {**result, "episodes_by_step": lasting.tolist()}


def headline(measured: Sequence[EpisodeAccuracy], horizon: int) -> dict[str, Estimate]:
    """Average each measure over episodes; a step-wise one counts with its mean over `horizon` steps."""
    rows = [episode_means(each, horizon) for each in measured]
    keys = dict.fromkeys(name for row in rows for name in row)
    return {name: Estimate.mean(np.array([row.get(name, np.nan) for row in rows])) for name in keys}


def episode_means(episode: EpisodeAccuracy, horizon: int) -> dict[str, float]:
    """Return one value of every measure for an episode, NaN where it has none."""
    means = {name: _finite_mean(values[:horizon]) for name, values in episode.steps.items()}
    return means | episode.whole


def stacked(rows: Sequence[np.ndarray], horizon: int) -> np.ndarray:
    """Stack rows of different lengths, cut at `horizon` and padded with NaN. → (E, T)"""
    width = min(horizon, max(map(len, rows), default=0))
    padded = np.full((len(rows), width), np.nan)
    for target, row in zip(padded, rows, strict=True):
        target[: len(row)] = row[:width]
    return padded


def json_list(values: np.ndarray) -> list[float | None]:
    """Round to four digits, with None for NaN, which JSON lacks."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in values]


def _finite_mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan


def absolute_control(table: EpisodeTable) -> bool | None:
    """Whether actions are absolute targets, which follow components of the state. None without a state."""
    moving = table.action[:, np.ptp(table.action, axis=0) > 0]
    measured = table.state[:, np.ptp(table.state, axis=0) > 0]
    if not moving.size or not measured.size:
        return None
    together = np.corrcoef(moving, measured, rowvar=False)[: moving.shape[1], moving.shape[1] :]
    return bool(np.median(np.abs(together).max(1)) >= ABSOLUTE)


def extreme_actions(
    actions: Tensor, low: np.ndarray, high: np.ndarray, absolute: bool | None
) -> dict[str, Tensor]:
    """Make actions that no demonstration holds, each (E, T, A).

    Args:
        actions: the episodes' actions (E, T, A).
        low, high: extremes of the dataset's actions (A,).
        absolute: whether actions are absolute targets or displacements, None if that is unknown.

    Returns:
        saturated: one corner of the box between the extremes all the time, another for each episode;
        reversed: the own motion in the opposite direction; frozen: actions under which the robot stays: zero
        displacements, or the first target. Both are left out where `absolute` is None.
    """
    corner = np.random.default_rng(0).random((len(actions), actions.shape[-1])) < 0.5
    saturated = torch.from_numpy(np.where(corner, low, high).astype(np.float32)).to(actions)
    made = {"saturated": saturated[:, None].expand_as(actions)}
    if absolute is not None:
        still = actions[:, :1] if absolute else torch.zeros_like(actions[:, :1])
        made |= {"reversed": 2 * still - actions, "frozen": still.expand_as(actions)}
    return made


@dataclass(frozen=True)
class Robustness:
    """What extreme actions do, by their name (`extreme_actions`).

    Args:
        episodes: how many were imagined.
        frames: how many of each.
        absolute_control: whether actions are absolute targets; None if that is unknown.
        predicted_success: episodes predicted as successes.
        psnr_to_start: PSNR (dB) of the last against the first frame, both decoded.
    """

    episodes: int
    frames: int
    absolute_control: bool | None
    predicted_success: dict[str, Proportion]
    psnr_to_start: dict[str, Estimate]

    def as_json(self) -> dict[str, Any]:
        """Return the measures as JSON."""
        by_name = {
            name: {"predicted_success": rate.as_json(), "psnr_to_start": self.psnr_to_start[name].as_json()}
            for name, rate in self.predicted_success.items()
        }
        sizes = {"episodes": self.episodes, "frames": self.frames, "absolute_control": self.absolute_control}
        return sizes | by_name


@torch.no_grad()
def robustness(
    model: ActionWorldModelRewardModel,
    recording: Recording,
    episodes: np.ndarray,
    criterion: SuccessCriterion,
) -> Robustness:
    """Imagine `HORIZON_SECONDS` under each kind of extreme actions, from at most `BATCH` starts.

    Frozen actions cannot succeed and ought to leave the image as it is.
    """
    episodes, device = episodes[evenly_spaced(len(episodes), BATCH)], model.device
    table, horizon = recording.table, recording.steps(HORIZON_SECONDS)
    starts, recorded = recording.starts(model, episodes), recording.actions(episodes, horizon, device)
    absolute = absolute_control(table)
    made = extreme_actions(recorded, table.action.min(0), table.action.max(0), absolute)
    result = Robustness(len(episodes), horizon, absolute, {}, {})
    for name, actions in made.items():
        imagined = imagine_frames(model, starts, actions)
        predicted = criterion.first_met(imagined.done_probability.cpu().numpy()) >= 0
        pair = starts.tokens, imagined.tokens[:, -1]
        first, last = (model.tokenizer.decode(tokens, starts.context) for tokens in pair)
        result.predicted_success[name] = Proportion.of(predicted)
        result.psnr_to_start[name] = Estimate.mean(psnr(last, first).cpu().numpy())
    return result
