"""Evaluation of a world model on recorded episodes: one pass over them, then metrics, tables, pictures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from lerobot_wmrl.common.constants import KINDS, PLAY, START_KIND
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import markdown_table
from lerobot_wmrl.common.statistics import Estimate, Proportion, evenly_spaced
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.frames import NO_CONTEXT
from lerobot_wmrl.evaluation import pictures
from lerobot_wmrl.evaluation.accuracy import (
    HORIZON_SECONDS,
    EpisodeAccuracy,
    Robustness,
    by_step,
    headline,
    measure,
    robustness,
)
from lerobot_wmrl.evaluation.agreement import MIN_POLICIES, Agreement
from lerobot_wmrl.evaluation.gate import (
    DOUBTFUL_AUC,
    SWEEP_FRAMES,
    SWEEP_THRESHOLDS,
    Gate,
    best_operating_point,
    done_accuracy,
    gate_at,
    gate_details,
    sweep,
)
from lerobot_wmrl.evaluation.goals import GoalQuality, goal_quality, imagine_goals
from lerobot_wmrl.evaluation.image_metrics import cached_lpips
from lerobot_wmrl.evaluation.outcomes import Outcomes, by_task, seen_outcomes
from lerobot_wmrl.evaluation.replay import COMPARED_FRAMES, EpisodeReplay, Recording, replay_episodes
from lerobot_wmrl.evaluation.success_probe import train_probe
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)

MAX_GOALS = 64
"""Goal frames that a report looks at."""

LARGER: Final = (
    " Train the tokenizer with larger frames (--model.tokenizer.image_size), or with a camera that shows "
    "success better."
)
"""The remedy where success is hardly seen."""

TOP_LEVEL = ("delta_psnr_0_6s", "done_delay_frames")
"""Headline numbers that metrics.json also holds without their intervals."""

TITLES = {
    "psnr": "PSNR (dB)",
    "psnr_ceiling": "PSNR of the tokenizer alone (dB)",
    "psnr_1_2s": "PSNR after 1.2 s (dB)",
    "psnr_ceiling_1_2s": "PSNR of the tokenizer alone after 1.2 s (dB)",
    "psnr_below_ceiling_1_2s": "below the tokenizer after 1.2 s (dB)",
    "moving_psnr": "PSNR of moved pixels (dB)",
    "moving_psnr_ceiling": "PSNR of moved pixels, tokenizer alone (dB)",
    "delta_psnr_0_6s": "delta-PSNR after 0.6 s (dB)",
    "ssim": "SSIM",
    "tokenizer_lpips": "LPIPS's formula on tokenizer features",
    "lpips_alex": "LPIPS (AlexNet)",
    "token_accuracy": "token accuracy",
    "tcp_error_mm": "error of the TCP (mm)",
    "abs_rel": "AbsRel",
    "delta_1": "depth δ1",
    "delta_2": "depth δ2",
    "spatial_iou": "spatial IoU",
    "spatiotemporal_iou": "spatiotemporal IoU",
    "weighted_spatial_iou": "weighted spatial IoU",
    "mse": "MSE",
    "done_precision": "done precision, by frame",
    "done_recall": "done recall, by frame",
    "done_f1": "done F1, by frame",
    "done_log_loss": "done log loss (nats a frame)",
    "episode_precision": "success precision, by episode",
    "episode_recall": "success recall, by episode",
    "episode_f1": "success F1, by episode",
    "done_delay_frames": "delay of done (frames)",
    "done_distance_frames": "delay of done, early or late (frames)",
}
"""Titles of the measures in metrics.json, in the order of the table."""


@dataclass(frozen=True)
class ReplayEvaluation:
    """Measures of one pass over recorded episodes.

    Args:
        accuracy: accuracy of every episode, in order.
        attempts: the episodes that attempt a task.
        outcomes: outcomes of these; none if success was not recorded.
        shown: replays of the shortest success and the shortest failure, by name.
    """

    accuracy: list[EpisodeAccuracy]
    attempts: np.ndarray
    outcomes: Outcomes
    shown: dict[str, EpisodeReplay]


class Report(NamedTuple):
    """`metrics` for metrics.json, and `page` in Markdown."""

    metrics: dict[str, Any]
    page: str


def evaluate(
    model: ActionWorldModelRewardModel,
    recording: Recording,
    episodes: np.ndarray,
    episode_length: int | None = None,
) -> ReplayEvaluation:
    """Replay and measure the episodes, keeping the measures and only two replays' frames.

    Args:
        model: the world model.
        recording: what was recorded.
        episodes: which of it. (E,)
        episode_length: frames of each that outcomes are judged by; by default all.

    Raises:
        FieldError: there is nothing to predict, because every episode has a single frame.
    """
    if recording.table.length[episodes].max() < 2:
        raise FieldError(
            "dataset.root",
            recording.table.dataset.root,
            "every chosen episode has a single frame: there is nothing to predict",
            "use a dataset with longer episodes",
        )
    lpips = cached_lpips(model.device)
    accuracy, replays = [], []
    shown: dict[str, EpisodeReplay] = {}
    for run in replay_episodes(model, recording, episodes):
        accuracy.append(measure(model, recording, run, lpips))
        replays.append(replace(run, tokens=run.tokens.new_empty(0), context=NO_CONTEXT))
        if recording.table.column(START_KIND)[run.episode] != KINDS.index(PLAY) and len(run.done) > 1:
            shown.setdefault("success" if run.done.any() else "failure", run)
    accuracy.sort(key=lambda each: each.episode)
    outcomes = Outcomes.stack(replays).attempts(recording.table).within(episode_length)
    known = outcomes.where(np.full(len(outcomes.episodes), recording.table.has_labels))
    return ReplayEvaluation(accuracy, outcomes.episodes, known, shown)


def report_action_model(
    model: ActionWorldModelRewardModel,
    recording: Recording,
    evaluation: ReplayEvaluation,
    criterion: SuccessCriterion,
    folder: Path,
) -> Report:
    """Report accuracy, done, gate and robustness, and save their pictures in `folder`."""
    outcomes, horizon = evaluation.outcomes, recording.steps(HORIZON_SECONDS)
    taught = outcomes.as_taught(recording.table)
    estimates = headline(evaluation.accuracy, horizon) | done_accuracy(taught, criterion)
    kinds = recording.table.column(START_KIND)
    play = [each for each in evaluation.accuracy if kinds[each.episode] == KINDS.index(PLAY)]
    steps, play_steps = by_step(evaluation.accuracy, horizon), by_step(play, COMPARED_FRAMES)
    gate, gates, tasks = gate_at(outcomes, criterion), sweep(outcomes), by_task(outcomes, recording.table)
    at_task = {task: gate_at(task_outcomes, criterion) for task, task_outcomes in tasks.items()}
    best_at_task = {task: best_operating_point(sweep(task_outcomes)) for task, task_outcomes in tasks.items()}
    best = best_operating_point(gates)
    extremes = robustness(model, recording, evaluation.attempts, criterion)
    seen = seen_outcomes(model, recording, outcomes.episodes)
    seen_auc = math.nan if seen is None else seen.auc(criterion.frames)
    metrics = {
        **gate_details(outcomes, gate),
        **{name: estimates[name].as_json()["value"] if name in estimates else None for name in TOP_LEVEL},
        "horizon_frames": horizon,
        "headline": {name: estimate.as_json() for name, estimate in estimates.items()},
        **steps,
        "play": {"episodes": len(play), **play_steps},
        "operating_point": best.as_json() if best else None,
        "seen_auc": None if math.isnan(seen_auc) else seen_auc,
        "gate_by_task": {task: gate.as_json() for task, gate in at_task.items()},
        "operating_point_by_task": {task: point and point.as_json() for task, point in best_at_task.items()},
        "gate_sweep": [gate.as_json() for gate in gates],
        "extreme_actions": extremes.as_json(),
    }
    pictures.save_accuracy(steps, folder / "accuracy.png")
    if play:
        pictures.save_accuracy(play_steps, folder / "accuracy_play.png")
    pictures.save_sweep(gates, folder / "gate_sweep.png")
    pictures.save_comparisons(model, recording, evaluation.shown, folder)
    page = [
        headline_table(estimates),
        gate_lines(gate, best),
        *([] if math.isnan(seen_auc) else [seen_line(seen_auc, LARGER)]),
        *([task_table(at_task, best_at_task)] if tasks else []),
        "False positives / recall, in percent:",
        sweep_table(gates),
        robustness_table(extremes),
    ]
    return Report(metrics, "\n\n".join(page))


def report_goals(
    text_model: TextWorldModelRewardModel, recording: Recording, evaluation: ReplayEvaluation, folder: Path
) -> Report:
    """Report goal frames from the starts of the evaluated episodes, and save goal_frames.png in `folder`."""
    attempts = evaluation.attempts
    goals = imagine_goals(text_model, recording, attempts[evenly_spaced(len(attempts), MAX_GOALS)])
    quality = goal_quality(goals, train_probe(text_model.tokenizer, recording))
    pictures.save_goals(goals, folder / "goal_frames.png")
    return Report({"goal_frames": quality.as_json()}, goal_table(quality))


def report_agreement(agreement: Agreement, folder: Path) -> Report:
    """Report the success of policies in both environments, and save policies.png in `folder`."""
    pictures.save_agreement(agreement, folder / "policies.png")
    return Report({"policies": agreement.as_json()}, agreement_table(agreement))


def headline_table(estimates: Mapping[str, Estimate]) -> str:
    """List every measure with its interval, in the order of `TITLES`."""
    rows = [
        (title, str(estimates[name]), estimates[name].n)
        for name, title in TITLES.items()
        if name in estimates
    ]
    return markdown_table(("measure", "mean (bootstrap 95 %)", "episodes"), rows)


def gate_lines(gate: Gate, best: Gate | None) -> str:
    """Describe the gate at the chosen operating point, and the best one."""
    lines = [
        f"Gate at {gate.criterion}: {'passed' if gate.passed else 'not passed'}.",
        f"False positives (failures predicted as successes): {gate.false_positives}.",
        f"Recall (successes predicted as successes): {gate.recall}.",
    ]
    if not math.isnan(gate.auc):
        lines.append(
            f"AUC of successes against failures, over all thresholds: {gate.auc:.2f} (0.5 is chance)."
        )
    if gate.cut_short:
        lines.append(
            f"{gate.cut_short} of the successes end before they have held for {gate.criterion.frames} frames"
            + (
                ". As most do, the prediction for the last frame of every episode is repeated."
                if gate.repeats_last
                else ". They cannot be predicted; lower done_frames, or record on after success."
            )
        )
    if best is None:
        lines.append("No operating point has any recall with at most 5 % false positives.")
    else:
        lines.append(
            f"Best with at most 5 % false positives: {best.criterion}; "
            f"false positives {best.false_positives}; recall {best.recall}."
        )
    return "\n".join(lines)


def seen_line(auc: float, remedy: str) -> str:
    """Say how well success is seen in recorded frames, `Outcomes.auc` of these, and what helps if hardly."""
    sentence = f"In the recorded frames themselves the success classifier has an AUC of {auc:.2f}"
    if auc >= DOUBTFUL_AUC:
        return f"{sentence}."
    return f"{sentence}: it hardly sees success in them, and the world model has success from it.{remedy}"


def task_table(gates: Mapping[str, Gate], best: Mapping[str, Gate | None]) -> str:
    """List the gate of each task at one operating point, beside the operating point that is best for it.

    Below the table, tasks of which no success is recognised are named.
    """
    rows = [
        (
            task,
            gate.false_positives,
            gate.recall,
            "–" if math.isnan(gate.auc) else f"{gate.auc:.2f}",
            "yes" if gate.passed else "no",
            "–" if not gate.recall.n or not gate.false_positives.n else _best(best[task]),
        )
        for task, gate in gates.items()
    ]
    column = "threshold, frames: recall with at most 5 % false positives"
    table = markdown_table(("task", "false positives", "recall", "AUC", "passed", column), rows)
    blind = [task for task, gate in gates.items() if gate.recall.n and not gate.recall.k]
    if not blind:
        return table
    return (
        f"{table}\n\nNo recorded success of {', '.join(blind)} is recognised, so RL would be rewarded there "
        "seldom or never. One threshold holds for all tasks: choose one at which each is recognised, or "
        "train a world model for these alone."
    )


def sweep_table(gates: Sequence[Gate]) -> str:
    """Tabulate false positives / recall in percent by threshold and frames."""
    at = {gate.criterion: gate for gate in gates}
    rows = [
        (threshold, *(_percentages(at[SuccessCriterion(threshold, frames)]) for frames in SWEEP_FRAMES))
        for threshold in SWEEP_THRESHOLDS
    ]
    return markdown_table(("threshold", *(f"k = {frames}" for frames in SWEEP_FRAMES)), rows)


def robustness_table(extremes: Robustness) -> str:
    """Tabulate predicted successes and the PSNR to the start under extreme actions."""
    rows = [
        (name, _count(rate), extremes.psnr_to_start[name])
        for name, rate in extremes.predicted_success.items()
    ]
    return markdown_table(("actions", "predicted success", "PSNR to the start (dB)"), rows)


def goal_table(quality: GoalQuality) -> str:
    """Tabulate the quality of the text model's goal frames."""
    rows: list[tuple[str, object]] = [
        ("goals that reach the done threshold", _count(quality.goal_reached)),
        ("distance to the nearest recorded final frame", quality.nearest_final_tokenizer_lpips),
        ("the same distance of the start frame", quality.start_to_final_tokenizer_lpips),
        ("PSNR to the nearest recorded final frame (dB)", quality.nearest_final_psnr),
    ]
    if quality.success_holds and quality.success_holds_in_finals and quality.probe:
        accuracy = quality.probe.balanced_accuracy
        known = "unknown" if math.isnan(accuracy) else f"{accuracy:.3f}"
        rows += [
            ("goals in which success holds, by the success probe", _count(quality.success_holds)),
            ("the same of recorded final frames it has not seen", _count(quality.success_holds_in_finals)),
            ("balanced accuracy of the success probe", known),
        ]
    return markdown_table(("goal frames", "value"), rows)


def agreement_table(agreement: Agreement) -> str:
    """Tabulate the success of policies in both environments, and their correlation."""
    rows = [[name, str(imagined), str(real)] for name, (imagined, real) in agreement.policies.items()]
    r, low, high = agreement.correlation()
    verdict = f"Pearson's r {r:.2f} ({low:.2f} to {high:.2f}), R² {r * r:.2f}"
    if np.isnan(r):
        verdict = f"No correlation: it takes {MIN_POLICIES} policies, of which some succeed more often."
    head = ["policy", "success in the world model", "success in `real_env`"]
    return f"{markdown_table(head, rows)}\n\n{verdict}"


def _best(gate: Gate | None) -> str:
    return f"{gate.criterion.threshold}, {gate.criterion.frames}: {gate.recall}" if gate else "none"


def _percentages(gate: Gate) -> str:
    return " / ".join(
        f"{100 * rate.share:.0f}" if rate.n else "–" for rate in (gate.false_positives, gate.recall)
    )


def _count(rate: Proportion) -> str:
    return f"{rate.k} of {rate.n}"
