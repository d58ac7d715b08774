"""What the evaluation leaves: the numbers for metrics.json, tables for people, and pictures."""

from pathlib import Path
from typing import Any, NamedTuple

from lerobot_wmrl.common.constants import KINDS, PLAY
from lerobot_wmrl.evaluation import pictures, tables
from lerobot_wmrl.evaluation.accuracy import HORIZON, by_step, headline
from lerobot_wmrl.evaluation.done import done_quality
from lerobot_wmrl.evaluation.evaluate import Evaluation
from lerobot_wmrl.evaluation.extreme_actions import robustness
from lerobot_wmrl.evaluation.gate import (
    best_operating_point,
    gate_at,
    gates_by_task,
    success_agreement,
    sweep,
)
from lerobot_wmrl.evaluation.goals import goal_quality, imagine_goals
from lerobot_wmrl.evaluation.replay import LONGEST, Source
from lerobot_wmrl.evaluation.success_probe import train_probe
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)

TOP_LEVEL = ("delta_psnr_15", "done_delay_frames")
"""Headline numbers that metrics.json also holds without their intervals."""


class Report(NamedTuple):
    """`numbers` for metrics.json and `page` in Markdown."""

    numbers: dict[str, Any]
    page: str


def report_action_model(
    model: ActionWorldModelRewardModel, source: Source, evaluation: Evaluation,
    threshold: float, frames: int, folder: Path,
) -> Report:  # fmt: skip
    """Accuracy, done, gate and robustness; accuracy.png, gate_sweep.png and comparisons in `folder`."""
    outcomes = evaluation.outcomes
    estimates = headline(evaluation.accuracy) | done_quality(outcomes, threshold, frames)
    play = [e for e in evaluation.accuracy if source.table.kind[e.episode] == KINDS.index(PLAY)]
    steps, gates = by_step(evaluation.accuracy, HORIZON), sweep(outcomes)
    best = best_operating_point(gates)
    by_task = gates_by_task(outcomes, source.table, threshold, frames)
    extremes = robustness(model, source, evaluation.attempts, threshold, frames)
    numbers = {
        **success_agreement(outcomes, threshold, frames),
        **{name: estimates[name].as_json()["value"] if name in estimates else None for name in TOP_LEVEL},
        "headline": {name: estimate.as_json() for name, estimate in estimates.items()},
        **steps,
        "play": {"episodes": len(play), **by_step(play, LONGEST)},
        "operating_point": best.as_json() if best else None,
        "gate_by_task": {task: gate.as_json() for task, gate in by_task.items()},
        "gate_sweep": [gate.as_json() for gate in gates],
        "extreme_actions": extremes,
    }
    pictures.save_accuracy(steps, folder / "accuracy.png")
    if play:
        pictures.save_accuracy(numbers["play"], folder / "accuracy_play.png")
    pictures.save_sweep(gates, folder / "gate_sweep.png")
    for name, run in evaluation.shown.items():
        shown = pictures.side_by_side(model, source, run)
        pictures.save_animation(shown, folder / f"comparison_{name}.gif")
        pictures.save_strip(shown, folder / f"comparison_{name}_strip.png")
    page = [
        tables.headline_table(estimates),
        tables.gate_lines(gate_at(outcomes, threshold, frames), best),
        *([tables.task_table(by_task)] if by_task else []),
        "Failures called successes / successes recognised, in percent:",
        tables.sweep_table(gates),
        tables.robustness_table(extremes),
    ]
    return Report(numbers, "\n\n".join(page))


def report_goals(
    text_model: TextWorldModelRewardModel, source: Source, evaluation: Evaluation, folder: Path
) -> Report:
    """Goal frames from the starts of the evaluated episodes; goal_frames.png in `folder`."""
    goals = imagine_goals(text_model, source, evaluation.attempts)
    quality = goal_quality(goals, train_probe(text_model.tokenizer, source))
    pictures.save_goals(goals, folder / "goal_frames.png")
    return Report({"goal_frames": quality}, tables.goal_table(quality))
