"""Pictures of what a world model imagines, beside what happened."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from lerobot_wmrl.strips import GAP, enlarged, evenly_spaced, in_a_row
from lerobot_wmrl.world_models.evaluation import Replay, decode
from lerobot_wmrl.world_models.frame_cache import frames_to_tensor
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

SCALE = 3
STRIP_FRAMES = 8


def side_by_side(model: ActionWorldModelRewardModel, run: Replay, index: int) -> np.ndarray:
    """One episode: real frames above, imagined ones below. → (T, 2H + gap, N·W, 3) uint8"""
    length = int(run.table.length[run.episodes[index]])
    real = np.stack([run.real_frames(step)[index] for step in range(length)])
    first = frames_to_tensor(real[:1]).to(model.state_mean.device)
    start = model.tokenizer.encode(first, run.context[[index]])
    tokens = torch.cat([start, run.imagined.tokens[index, : length - 1]])
    imagined = (decode(model, tokens, run.context[[index] * length]) * 255).round().astype(np.uint8)
    rows = [np.concatenate(list(cameras.swapaxes(0, 1)), 2) for cameras in (real, imagined)]
    gap = np.full((length, GAP, *rows[0].shape[2:]), 255, np.uint8)
    return np.concatenate([rows[0], gap, rows[1]], 1)


def save_animation(frames: np.ndarray, path: Path) -> None:
    """(T, H, W, 3) uint8 as a GIF at 10 frames a second."""
    images = [enlarged(frame, SCALE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=100, loop=0)


def save_strip(frames: np.ndarray, path: Path) -> None:
    """A few evenly spaced frames of (T, H, W, 3) in one row."""
    enlarged(in_a_row(frames[evenly_spaced(len(frames), STRIP_FRAMES)]), SCALE).save(path)


def save_goals(curves: dict[str, dict[str, Any]], path: Path) -> None:
    """For each episode: the goal frame that the text model imagined, and the frame it really ended with."""
    figure, axes = plt.subplots(2, len(curves), figsize=(2.4 * len(curves), 4.8), squeeze=False)
    for column, (name, curve) in enumerate(curves.items()):
        for row, (key, title) in enumerate((("goal_frame", "goal"), ("final_frame", "real end"))):
            axes[row][column].imshow(np.concatenate(list(curve[key]), 1))
            axes[row][column].set_title(f"{title}\n{name}", fontsize=8)
            axes[row][column].axis("off")
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


def save_accuracy(accuracy: dict[str, Any], path: Path) -> None:
    """PSNR by imagined step, and the error of the imagined TCP."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 2.8))
    left.plot(accuracy["psnr_by_step"], label="whole frame")
    left.plot(accuracy["moving_psnr_by_step"], label="what moved")
    left.set_title("PSNR (dB) by imagined frame", fontsize=10)
    left.legend(fontsize=8)
    right.plot(accuracy["tcp_error_mm_by_step"])
    right.set_title("error of the imagined TCP (mm)", fontsize=10)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
