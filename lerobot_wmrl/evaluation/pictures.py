"""Pictures of evaluations: recorded beside imagined frames, goal frames, measures by step, success rates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from lerobot_wmrl.common.frame_strips import GAP, enlarged, in_a_row
from lerobot_wmrl.common.images import to_pixels
from lerobot_wmrl.common.statistics import evenly_spaced
from lerobot_wmrl.evaluation.agreement import Agreement
from lerobot_wmrl.evaluation.comparison import Comparison
from lerobot_wmrl.evaluation.gate import SWEEP_FRAMES, SWEEP_THRESHOLDS, Gate
from lerobot_wmrl.evaluation.goals import Goals
from lerobot_wmrl.evaluation.judgement import Judgement
from lerobot_wmrl.evaluation.replay import EpisodeReplay, Recording
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

SCALE = 3
STRIP_FRAMES = 8
SHOWN_GOALS = 8


@torch.no_grad()
def side_by_side(
    model: ActionWorldModelRewardModel, recording: Recording, replay: EpisodeReplay
) -> np.ndarray:
    """Show one episode, recorded frames above imagined ones. → (T, 2H + gap, N·W, 3) uint8"""
    recorded = recording.frames[recording.compared_rows(replay.episode)]
    first, context = recording.first_frames(np.array([replay.episode]), model.tokenizer)
    tokens = torch.cat([first, replay.tokens[: len(recorded) - 1]])
    imagined = to_pixels(model.tokenizer.decode(tokens, context[[0] * len(tokens)]))
    rows = [np.concatenate(list(cameras.swapaxes(0, 1)), 2) for cameras in (recorded, imagined)]
    gap = np.full((len(recorded), GAP, *rows[0].shape[2:]), 255, np.uint8)
    return np.concatenate([rows[0], gap, rows[1]], 1)


def save_comparisons(
    model: ActionWorldModelRewardModel, recording: Recording, shown: Mapping[str, EpisodeReplay], folder: Path
) -> None:
    """Save each of the replays by name, as an animation and as a strip."""
    for name, replay in shown.items():
        frames = side_by_side(model, recording, replay)
        save_animation(frames, folder / f"comparison_{name}.gif")
        save_strip(frames, folder / f"comparison_{name}_strip.png")


def save_animation(frames: np.ndarray, path: Path) -> None:
    """Save (T, H, W, 3) uint8 as a GIF at 10 frames a second."""
    images = [enlarged(frame, SCALE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=100, loop=0)


def save_strip(frames: np.ndarray, path: Path) -> None:
    """Save a few evenly spaced frames of (T, H, W, 3) in one row."""
    enlarged(in_a_row(frames[evenly_spaced(len(frames), STRIP_FRAMES)]), SCALE).save(path)


def save_goals(goals: Goals, path: Path) -> None:
    """Save a sheet of start, goal frame and nearest recorded final frame for some episodes."""
    shown = evenly_spaced(len(goals.episodes), SHOWN_GOALS)
    rows = {"start": goals.start[shown], "goal": goals.goal[shown]}
    if goals.finals is not None and (goals.nearest >= 0).all():
        rows["nearest final"] = goals.finals.images[goals.nearest[shown]]
    pictures = {title: to_pixels(images) for title, images in rows.items()}
    size = 1.5 * len(shown), 1.7 * len(pictures)
    figure = Figure(figsize=size)
    axes = figure.subplots(len(pictures), len(shown), squeeze=False)
    for line, (title, images) in zip(axes, pictures.items(), strict=True):
        for axis, cameras in zip(line, images, strict=True):
            axis.imshow(np.concatenate(list(cameras), 1))
            axis.set_title(title, fontsize=7)
            axis.axis("off")
    for axis, episode in zip(axes[0], goals.episodes[shown], strict=True):
        axis.set_title(f"episode {episode}\nstart", fontsize=7)
    _save(figure, path)


def save_reward_curves(curves: dict[str, dict[str, Any]], path: Path) -> None:
    """Plot the return of the general reward and its two parts along recorded episodes."""
    panels = (
        ("done_probability", "done probability"),
        ("similarity", "similarity to the goal"),
        ("return", "return"),
    )
    figure = Figure(figsize=(10, 2.8))
    axes = figure.subplots(1, len(panels))
    for axis, (key, title) in zip(axes, panels, strict=True):
        for name, curve in curves.items():
            axis.plot(curve[key], label=name)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("frame")
    axes[0].legend(fontsize=8)
    _save(figure, path)


ACCURACY_PANELS = {
    "PSNR (dB) by imagined frame": {"psnr": "prediction", "psnr_ceiling": "tokenizer alone"},
    "of moved pixels": {"moving_psnr": "prediction", "moving_psnr_ceiling": "tokenizer alone"},
    "token accuracy": {"token_accuracy": ""},
    "error of the imagined TCP (mm)": {"tcp_error_mm": ""},
}


def save_accuracy(by_step: Mapping[str, Any], path: Path) -> None:
    """Plot means by step with 95 % bands, beside the tokenizer alone, which bounds the prediction."""
    panels = {
        title: lines
        for title, lines in ACCURACY_PANELS.items()
        if any(f"{name}_by_step" in by_step for name in lines)
    }
    figure = Figure(figsize=(3.6 * len(panels), 2.8))
    axes = figure.subplots(1, len(panels), squeeze=False)
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
    """Plot false positives and recall by threshold, a line for each number of frames."""
    figure = Figure(figsize=(8, 2.8))
    axes = figure.subplots(1, 2)
    panels = {"false_positives": ("false positives (%)", 5), "recall": ("recall (%)", 90)}
    for axis, (name, (title, limit)) in zip(axes, panels.items(), strict=True):
        for frames in SWEEP_FRAMES:
            shares = [100 * getattr(gate, name).share for gate in gates if gate.criterion.frames == frames]
            axis.plot(SWEEP_THRESHOLDS, shares, label=f"k = {frames}")
        axis.axhline(limit, color="black", linewidth=0.8, linestyle=":")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("threshold")
    axes[1].legend(fontsize=6)
    _save(figure, path)


def save_agreement(agreement: Agreement, path: Path) -> None:
    """Plot a point a policy with Wilson intervals, beside the diagonal."""
    figure = Figure(figsize=(4.2, 4))
    axes = figure.subplots()
    axes.plot((0, 1), (0, 1), color="#999", linewidth=1, linestyle="--")
    for imagined, real in agreement.policies.values():
        axes.errorbar(
            imagined.share,
            real.share,
            real.whiskers,
            imagined.whiskers,
            color="#2b6cb0",
            marker="o",
            capsize=2,
        )
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="success in the world model", ylabel="success in real_env")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def save_comparison(comparison: Comparison, path: Path) -> None:
    """Draw the success rates with their 95 % intervals."""
    rates = comparison.rates()
    figure = Figure(figsize=(7, 1.2 + 0.5 * len(rates)), layout="constrained")
    axes = figure.subplots()
    for place, rate in enumerate(rates.values()):
        axes.barh(place, rate.share, 0.6, color="#2b6cb0")
        axes.errorbar(rate.share, place, xerr=rate.whiskers, color="#333", capsize=4)
    axes.set_yticks(range(len(rates)), list(rates))
    axes.invert_yaxis()
    axes.set_xlim(0, 1)
    axes.set_xlabel(f"success rate over {len(comparison.episodes)} starts, with 95 % intervals")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


def save_judgement(judgement: Judgement, path: Path) -> None:
    """Draw the estimates with their intervals, and imagined and known real success as points."""
    figure = Figure(figsize=(7, 1.4 + 0.5 * len(judgement.outcomes)), layout="constrained")
    axes = figure.subplots()
    for place, name in enumerate(judgement.outcomes):
        estimate = judgement.estimate(name)
        if estimate is not None:
            whiskers = [[estimate.value - estimate.low], [estimate.high - estimate.value]]
            axes.errorbar(estimate.value, place, xerr=whiskers, color="#2b6cb0", marker="o", capsize=4)
        axes.plot(judgement.imagined(name).share, place, color="#999", marker="|", markersize=12)
        if name in judgement.references:
            axes.plot(judgement.references[name].share, place, color="#c05621", marker="x")
    axes.set_yticks(range(len(judgement.outcomes)), list(judgement.outcomes))
    axes.invert_yaxis()
    axes.set_xlim(0, 1)
    axes.set_xlabel("success rate: estimated (blue), imagined (grey), known (orange)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
