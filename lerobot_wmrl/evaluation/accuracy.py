"""Accuracy of an open-loop replay: imagined against recorded frames by step, and under extreme actions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.statistics import Estimate, Proportion, bootstrap_ratio
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.evaluation.gate import first_run
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
    DELTA_PSNR_STEP,
    EpisodeReplay,
    Recording,
    imagine_frames,
)
from lerobot_wmrl.maniskill.embodiment import STATE_NAMES
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

HORIZON = 48
"""Steps to which the accuracy over all episodes is reported: the model's window."""

CEILING_STEP = 30
"""Step at which the prediction is compared with the tokenizer's reconstruction, the best that it could be."""


@dataclass(frozen=True)
class EpisodeAccuracy:
    """Measures of one episode: `steps`, (T − 1,) values an imagined frame; `whole`, one value an episode."""

    episode: int
    steps: dict[str, np.ndarray]
    whole: dict[str, float]


@torch.no_grad()
def measure(
    model: ActionWorldModelRewardModel, recording: Recording, replay: EpisodeReplay,
    lpips: PerceptualDistance | None,
) -> EpisodeAccuracy:  # fmt: skip
    """Compare the imagined frames of one episode with the recorded ones."""
    images = recording.images(replay.episode, replay.tokens.device)
    if len(images) < 2:
        return EpisodeAccuracy(replay.episode, {}, {})
    steps, whole = compare_frames(model.tokenizer, images, replay.tokens[:-1], replay.context, lpips)
    if predicts_tcp(recording, replay):
        steps["tcp_error_mm"] = tcp_error_mm(recording, replay)
    if replay.depth is not None:
        steps |= depth_accuracy(imagined=replay.depth[1], recorded=replay.depth[0])
    if replay.shuffled is not None:
        target = images[DELTA_PSNR_STEP : DELTA_PSNR_STEP + 1]
        other = psnr(model.tokenizer.decode(replay.shuffled[None], replay.context), target)
        whole["delta_psnr_15"] = float(steps["psnr"][DELTA_PSNR_STEP - 1] - other)
    return EpisodeAccuracy(
        replay.episode, {name: value.cpu().numpy() for name, value in steps.items()}, whole
    )


def compare_frames(
    tokenizer: FrameTokenizer, images: Tensor, imagined_tokens: Tensor, context: Context,
    lpips: PerceptualDistance | None,
) -> tuple[dict[str, Tensor], dict[str, float]]:  # fmt: skip
    """Compare imagined with recorded frames, and with their reconstruction by the tokenizer, the ceiling.

    Args:
        images: recorded frames (T + 1, N, 3, H, W).
        imagined_tokens: (T, S), of all frames but the first.
        context: of the first frame, one row.
        lpips: LPIPS, None to leave it out.

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
    whole = physics_iq(moved[:HORIZON], moved_imagined[:HORIZON])
    whole["mse"] = float((imagined.images[:HORIZON] - recorded[:HORIZON]).square().mean())
    return steps, whole


def predicts_tcp(recording: Recording, replay: EpisodeReplay) -> bool:
    """Whether the model predicts a state that begins with the TCP's position in metres."""
    names = recording.table.dataset.features.get(OBS_STATE, {}).get("names") or []
    return bool(replay.state.shape[-1]) and list(names[:3]) == list(STATE_NAMES[:3])


def tcp_error_mm(recording: Recording, replay: EpisodeReplay) -> Tensor:
    """Distance of the imagined from the recorded TCP in millimetres, (T − 1,)."""
    recorded = torch.from_numpy(recording.table.state[recording.rows(replay.episode)][1:, :3])
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


def headline(measured: Sequence[EpisodeAccuracy]) -> dict[str, Estimate]:
    """Average each measure over episodes; a step-wise one counts with its mean up to `HORIZON`."""
    rows = [episode_means(each) for each in measured]
    keys = dict.fromkeys(name for row in rows for name in row)
    return {name: Estimate.mean(np.array([row.get(name, np.nan) for row in rows])) for name in keys}


def episode_means(episode: EpisodeAccuracy) -> dict[str, float]:
    """Return one value of every measure for an episode, NaN where it has none."""
    means = {name: _finite_mean(values[:HORIZON]) for name, values in episode.steps.items()}
    if len(episode.steps.get("psnr", ())) >= CEILING_STEP:
        own, best = (float(episode.steps[name][CEILING_STEP - 1]) for name in ("psnr", "psnr_ceiling"))
        means |= {"psnr_30": own, "psnr_ceiling_30": best, "psnr_below_ceiling_30": best - own}
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


def extreme_actions(own: Tensor, low: np.ndarray, high: np.ndarray) -> dict[str, Tensor]:
    """Make actions that no demonstration holds, each (E, T, A).

    Args:
        own: the episodes' actions (E, T, A).
        low, high: extremes of the dataset's actions (A,).

    Returns:
        saturated: one corner of the box between the extremes all the time, another for each episode;
        reversed: the own actions with the opposite sign; frozen: zeros.
    """
    corner = np.random.default_rng(0).random((len(own), own.shape[-1])) < 0.5
    saturated = torch.from_numpy(np.where(corner, low, high).astype(np.float32)).to(own)
    return {
        "saturated": saturated[:, None].expand_as(own),
        "reversed": -own,
        "frozen": torch.zeros_like(own),
    }


@torch.no_grad()
def robustness(
    model: ActionWorldModelRewardModel, recording: Recording, episodes: np.ndarray,
    threshold: float, frames: int,
) -> dict[str, Any]:  # fmt: skip
    """Imagine `HORIZON` frames under each kind of extreme actions, from at most `BATCH` starts.

    Frozen actions cannot succeed and ought to leave the image as it is.

    Returns:
        For each kind, the share of episodes predicted as successes, and the PSNR (dB) of the last against the
        first frame, both decoded.
    """
    episodes, device = episodes[:BATCH], model.state_mean.device
    starts, own = recording.starts(model, episodes), recording.actions(episodes, HORIZON, device)
    low, high = recording.table.action.min(0), recording.table.action.max(0)
    result: dict[str, Any] = {"episodes": len(episodes), "frames": HORIZON}
    for name, actions in extreme_actions(own, low, high).items():
        imagined = imagine_frames(model, starts, actions)
        predicted = first_run((imagined.done_probability >= threshold).cpu().numpy(), frames) >= 0
        pair = starts.tokens, imagined.tokens[:, -1]
        first, last = (model.tokenizer.decode(tokens, starts.context) for tokens in pair)
        result[name] = {
            "predicted_success": Proportion(int(predicted.sum()), len(predicted)).as_json(),
            "psnr_to_start": Estimate.mean(psnr(last, first).cpu().numpy()).as_json(),
        }
    return result
