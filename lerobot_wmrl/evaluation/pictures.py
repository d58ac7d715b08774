"""Pictures of what a world model imagines, beside what happened."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.frame_strips import GAP, enlarged, evenly_spaced, in_a_row
from lerobot_wmrl.evaluation.gate import SWEEP_FRAMES, SWEEP_THRESHOLDS, Gate
from lerobot_wmrl.evaluation.goals import Goals
from lerobot_wmrl.evaluation.replay import EpisodeReplay, Source
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

SCALE = 3
STRIP_FRAMES = 8
SHOWN_GOALS = 8


@torch.no_grad()
def side_by_side(model: ActionWorldModelRewardModel, source: Source, run: EpisodeReplay) -> np.ndarray:
    """One episode: real frames above, imagined ones below. → (T, 2H + gap, N·W, 3) uint8"""
    real = source.frames[source.rows(run.episode)]
    first, context = source.starts(np.array([run.episode]), model.tokenizer)
    tokens = torch.cat([first, run.tokens[: len(real) - 1]])
    imagined = to_uint8(model.tokenizer.decode(tokens, context[[0] * len(tokens)]))
    rows = [np.concatenate(list(cameras.swapaxes(0, 1)), 2) for cameras in (real, imagined)]
    gap = np.full((len(real), GAP, *rows[0].shape[2:]), 255, np.uint8)
    return np.concatenate([rows[0], gap, rows[1]], 1)


def to_uint8(images: Tensor) -> np.ndarray:
    """(T, N, 3, H, W) in [0, 1] → (T, N, H, W, 3)"""
    return (images * 255).round().byte().permute(0, 1, 3, 4, 2).cpu().numpy()


def save_animation(frames: np.ndarray, path: Path) -> None:
    """(T, H, W, 3) uint8 as a GIF at 10 frames a second."""
    images = [enlarged(frame, SCALE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=100, loop=0)


def save_strip(frames: np.ndarray, path: Path) -> None:
    """A few evenly spaced frames of (T, H, W, 3) in one row."""
    enlarged(in_a_row(frames[evenly_spaced(len(frames), STRIP_FRAMES)]), SCALE).save(path)


def save_goals(goals: Goals, path: Path) -> None:
    """A contact sheet: start, imagined goal, and the nearest real frame of a success, for some episodes."""
    shown = evenly_spaced(len(goals.episodes), SHOWN_GOALS)
    rows = {"start": goals.start[shown], "goal": goals.goal[shown]}
    if goals.finals is not None and (goals.nearest >= 0).all():
        rows["nearest end"] = goals.finals.images[goals.nearest[shown]]
    pictures = {title: to_uint8(images) for title, images in rows.items()}
    size = 1.5 * len(shown), 1.7 * len(pictures)
    figure, axes = plt.subplots(len(pictures), len(shown), figsize=size, squeeze=False)
    for line, (title, images) in zip(axes, pictures.items(), strict=True):
        for axis, cameras in zip(line, images, strict=True):
            axis.imshow(np.concatenate(list(cameras), 1))
            axis.set_title(title, fontsize=7)
            axis.axis("off")
    for axis, episode in zip(axes[0], goals.episodes[shown], strict=True):
        axis.set_title(f"episode {episode}\nstart", fontsize=7)
    _save(figure, path)


def save_reward_curves(curves: dict[str, dict[str, Any]], path: Path) -> None:
    """The general reward, summed so far, and its two parts along real episodes."""
    panels = (
        ("done_probability", "done probability"),
        ("similarity", "similarity to the goal"),
        ("return", "return"),
    )
    figure, axes = plt.subplots(1, len(panels), figsize=(10, 2.8))
    for axis, (key, title) in zip(axes, panels, strict=True):
        for name, curve in curves.items():
            axis.plot(curve[key], label=name)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("frame")
    axes[0].legend(fontsize=8)
    _save(figure, path)


ACCURACY_PANELS = {
    "PSNR (dB) by imagined frame": {"psnr": "prediction", "psnr_ceiling": "tokenizer alone"},
    "of what moved": {"moving_psnr": "prediction", "moving_psnr_ceiling": "tokenizer alone"},
    "token accuracy": {"token_accuracy": ""},
    "error of the imagined TCP (mm)": {"tcp_error_mm": ""},
}


def save_accuracy(by_step: Mapping[str, Any], path: Path) -> None:
    """Means by step with 95 % bands, beside what the tokenizer can at best draw."""
    panels = {
        title: lines
        for title, lines in ACCURACY_PANELS.items()
        if any(f"{name}_by_step" in by_step for name in lines)
    }
    figure, axes = plt.subplots(1, len(panels), figsize=(3.6 * len(panels), 2.8), squeeze=False)
    for axis, (title, lines) in zip(axes[0], panels.items(), strict=True):
        for name, label in lines.items():
            mean, low, high = (
                np.array(values, float) for values in (by_step[f"{name}_by_step"], *by_step["bands"][name])
            )
            steps = np.arange(1, len(mean) + 1)
            axis.plot(steps, mean, label=label)
            axis.fill_between(steps, low, high, alpha=0.2)
        axis.set_title(title, fontsize=10)
        if len(lines) > 1:
            axis.legend(fontsize=8)
    _save(figure, path)


def save_sweep(gates: Sequence[Gate], path: Path) -> None:
    """False successes and recognised successes by threshold, a line for each number of frames."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 2.8))
    titles = {"false_positives": "failures called successes (%)", "recall": "successes recognised (%)"}
    for axis, (name, title), limit in zip(axes, titles.items(), (5, 90), strict=True):
        for frames in SWEEP_FRAMES:
            shares = [100 * getattr(gate, name).share for gate in gates if gate.frames == frames]
            axis.plot(SWEEP_THRESHOLDS, shares, label=f"k = {frames}")
        axis.axhline(limit, color="black", linewidth=0.8, linestyle=":")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("threshold")
    axes[1].legend(fontsize=6)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
