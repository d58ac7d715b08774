"""How close the imagined frames of an episode come to the real ones, step by step."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.constants import STATE_NAMES
from lerobot_wmrl.common.statistics import Estimate, bootstrap_ratio
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.evaluation.alexnet_lpips import PerceptualDistance
from lerobot_wmrl.evaluation.depth import depth_accuracy
from lerobot_wmrl.evaluation.image_metrics import masked_psnr, motion_mask, psnr, ssim
from lerobot_wmrl.evaluation.motion import (
    spatial_iou,
    spatiotemporal_iou,
    weighted_spatial_iou,
)
from lerobot_wmrl.evaluation.replay import DELTA_PSNR_STEP, EpisodeReplay, Source
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, feature_distance
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

HORIZON = 48
"""Steps to which accuracy is reported of all episodes: the model's window."""

CEILING_STEP = 30
"""Where the prediction is compared with what the tokenizer could at best draw."""


@dataclass(frozen=True)
class EpisodeAccuracy:
    """`steps`: (T − 1,) numbers an imagined frame, by name; `whole`: one number an episode, by name."""

    episode: int
    steps: dict[str, np.ndarray]
    whole: dict[str, float]


@torch.no_grad()
def measure(
    model: ActionWorldModelRewardModel, source: Source, run: EpisodeReplay, lpips: PerceptualDistance | None
) -> EpisodeAccuracy:
    """Compare the imagined frames of one episode with the real ones."""
    images = source.images(run.episode, run.tokens.device)
    if len(images) < 2:
        return EpisodeAccuracy(run.episode, {}, {})
    steps, whole = compare_frames(model.tokenizer, images, run.tokens[:-1], run.context, lpips)
    if knows_tcp(source, run):
        steps["tcp_error_mm"] = tcp_error_mm(source, run)
    if run.depth is not None:
        steps |= depth_accuracy(imagined=run.depth[1], real=run.depth[0])
    if run.shuffled is not None:
        real = images[DELTA_PSNR_STEP : DELTA_PSNR_STEP + 1]
        other = psnr(model.tokenizer.decode(run.shuffled[None], run.context), real)
        whole["delta_psnr_15"] = float(steps["psnr"][DELTA_PSNR_STEP - 1] - other)
    return EpisodeAccuracy(run.episode, {name: value.cpu().numpy() for name, value in steps.items()}, whole)


def compare_frames(
    tokenizer: FrameTokenizer, images: Tensor, imagined_tokens: Tensor, context: Context,
    lpips: PerceptualDistance | None,
) -> tuple[dict[str, Tensor], dict[str, float]]:  # fmt: skip
    """Real frames (T + 1, N, 3, H, W) and imagined tokens (T, S) of all but the first: numbers a frame (T,),
    and Physics-IQ's an episode. The ceiling is what the tokenizer makes of the real frames; `context` is that
    of the first one."""
    first, real = images[:1], images[1:]
    tokens = tokenizer.encode(images, context[[0] * len(images)])
    beside = context[[0] * len(real)]
    ceiling, imagined = (tokenizer.decode_with_features(t, beside) for t in (tokens[1:], imagined_tokens))
    moved = motion_mask(real, first)
    distance = feature_distance(imagined.features, ceiling.features)
    steps = {
        "psnr": psnr(imagined.images, real),
        "psnr_ceiling": psnr(ceiling.images, real),
        "moving_psnr": masked_psnr(imagined.images, real, moved),
        "moving_psnr_ceiling": masked_psnr(ceiling.images, real, moved),
        "ssim": ssim(imagined.images, real),
        "tokenizer_lpips": distance.unflatten(0, (len(real), -1)).mean(1),
        "token_accuracy": (imagined_tokens == tokens[1:]).float().mean(1),
    }
    if lpips is not None:
        steps["lpips_alex"] = lpips(imagined.images, real)
    moved_imagined = motion_mask(imagined.images, tokenizer.decode(tokens[:1], context))
    whole = physics_iq(moved[:HORIZON], moved_imagined[:HORIZON])
    whole["mse"] = float((imagined.images[:HORIZON] - real[:HORIZON]).square().mean())
    return steps, whole


def physics_iq(real: Tensor, imagined: Tensor) -> dict[str, float]:
    """The three overlaps of motion masks (T, N, H, W)."""
    return {
        "spatial_iou": float(spatial_iou(real, imagined)),
        "spatiotemporal_iou": float(spatiotemporal_iou(real, imagined)),
        "weighted_spatial_iou": float(weighted_spatial_iou(real, imagined)),
    }


def knows_tcp(source: Source, run: EpisodeReplay) -> bool:
    """Whether the model predicts a state that begins with the TCP's position in metres."""
    names = source.table.dataset.features.get(OBS_STATE, {}).get("names") or []
    return bool(run.proprioception.shape[-1]) and list(names[:3]) == list(STATE_NAMES[:3])


def tcp_error_mm(source: Source, run: EpisodeReplay) -> Tensor:
    """Distance of the imagined from the real TCP, millimetres (T − 1,)."""
    real = torch.from_numpy(source.table.state[source.rows(run.episode)][1:, :3])
    return 1000 * (run.proprioception[:-1, :3].cpu() - real).norm(dim=-1)


def by_step(measured: Sequence[EpisodeAccuracy], horizon: int) -> dict[str, Any]:
    """Means over the episodes that last so long, with pointwise bootstrap 95 % bands, to `horizon` steps.

    `<name>_by_step`, `bands[name]` = [low, high], and the number of episodes behind each step.
    """
    shown = [e for e in measured if e.steps]
    result: dict[str, Any] = {"bands": {}}
    for name in names(shown):
        values = stacked([e.steps[name] for e in shown], horizon)
        known = np.isfinite(values)
        mean, low, high = bootstrap_ratio(np.where(known, values, 0), known)
        result[f"{name}_by_step"] = as_list(mean)
        result["bands"][name] = [as_list(low), as_list(high)]
    lasting = np.isfinite(stacked([e.steps["psnr"] for e in shown], horizon)).sum(0)
    return {**result, "episodes_by_step": lasting.tolist()}


def headline(measured: Sequence[EpisodeAccuracy]) -> dict[str, Estimate]:
    """Each measure's mean over episodes; of step-wise ones an episode counts its mean to `HORIZON`."""
    rows = [episode_numbers(e) for e in measured]
    keys = dict.fromkeys(name for row in rows for name in row)
    return {name: Estimate.mean(np.array([row.get(name, np.nan) for row in rows])) for name in keys}


def episode_numbers(episode: EpisodeAccuracy) -> dict[str, float]:
    """One number an episode of every measure, NaN where it has none."""
    numbers = {name: _finite_mean(values[:HORIZON]) for name, values in episode.steps.items()}
    if len(episode.steps.get("psnr", ())) >= CEILING_STEP:
        own, best = (float(episode.steps[name][CEILING_STEP - 1]) for name in ("psnr", "psnr_ceiling"))
        numbers |= {"psnr_30": own, "psnr_ceiling_30": best, "psnr_below_ceiling_30": best - own}
    return numbers | episode.whole


def names(measured: Sequence[EpisodeAccuracy]) -> list[str]:
    """The step-wise measures there are."""
    return list(dict.fromkeys(name for e in measured for name in e.steps))


def stacked(rows: Sequence[np.ndarray], horizon: int) -> np.ndarray:
    """Rows of different lengths, cut at `horizon` and padded with NaN. → (E, T)"""
    width = min(horizon, max(map(len, rows), default=0))
    padded = np.full((len(rows), width), np.nan)
    for target, row in zip(padded, rows, strict=True):
        target[: len(row)] = row[:width]
    return padded


def as_list(values: np.ndarray) -> list[float | None]:
    """For JSON, which has no NaN."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in values]


def _finite_mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan
