"""The gate: does the world model, replayed open loop, tell failed from successful episodes?

It decides whether a policy may be trained inside the model, and is meant for rollouts of policies that the
model was not trained on. A false positive is a recorded failure that the model predicts as a success.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from lerobot_wmrl.common.statistics import Estimate, Proportion
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.evaluation.outcomes import Outcomes, labelled_recording, predict_outcomes
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

MAX_FALSE_POSITIVE_RATE: Final = 0.05
MIN_RECALL: Final = 0.9
"""Limits within which the gate is passed."""

DOUBTFUL_AUC: Final = 0.8
"""AUC of successes against failures below which a reward says little."""

SWEEP_THRESHOLDS: Final = tuple(round(0.3 + 0.05 * step, 2) for step in range(14))
SWEEP_FRAMES: Final = tuple(range(1, 7))

MIN_PROBABILITY: Final = 1e-6
"""Keeps the log loss of an event finite that was predicted as impossible."""


@dataclass(frozen=True)
class Gate:
    """The gate at one criterion of success.

    Args:
        criterion: what counts as a predicted success.
        false_positives: of the recorded failures, those predicted as successes.
        recall: of the recorded successes, those predicted as successes.
        cut_short: episodes that end before their success has held for the criterion's frames.
        repeats_last: whether the prediction for the last frame is repeated (`Outcomes.padded_probability`);
            if not, no model can predict the successes that are cut short.
        auc: area under the ROC curve over all thresholds, `Outcomes.auc`.
    """

    criterion: SuccessCriterion
    false_positives: Proportion
    recall: Proportion
    cut_short: int
    repeats_last: bool
    auc: float

    @property
    def passed(self) -> bool:
        """Whether at most 5 % are false positives and recall is at least 90 %."""
        return self.false_positives.share <= MAX_FALSE_POSITIVE_RATE and self.recall.share >= MIN_RECALL

    def as_json(self) -> dict[str, Any]:
        return {
            "done_threshold": self.criterion.threshold,
            "done_frames": self.criterion.frames,
            "false_positive_rate": self.false_positives.as_json(),
            "recall": self.recall.as_json(),
            "successes_cut_short": self.cut_short,
            "repeats_last_frame": self.repeats_last,
            "auc": None if math.isnan(self.auc) else self.auc,
            "passed": self.passed,
        }


def success_gate(
    model: ActionWorldModelRewardModel, dataset_root: str | Path, criterion: SuccessCriterion
) -> Gate:
    """Replay every episode of a dataset of rollouts open loop and count false positives and recall.

    Raises:
        FieldError: the model cannot replay the dataset, or its episodes have no labels of success.
    """
    recording = labelled_recording(model, read_episodes(open_dataset(dataset_root)))
    return gate_at(predict_outcomes(model, recording), criterion)


def gate_at(outcomes: Outcomes, criterion: SuccessCriterion) -> Gate:
    """Count false positives and recall at one criterion of success."""
    predicted, success = outcomes.predicted_success(criterion), outcomes.success
    return Gate(
        criterion=criterion,
        false_positives=Proportion.of(predicted[~success]),
        recall=Proportion.of(predicted[success]),
        cut_short=int(outcomes.cut_short(criterion.frames).sum()),
        repeats_last=outcomes.ends_at_success(criterion.frames),
        auc=outcomes.auc(criterion.frames),
    )


def sweep(outcomes: Outcomes) -> list[Gate]:
    """Return the gate at every criterion of success, from the same replay."""
    return [
        gate_at(outcomes, SuccessCriterion(threshold, frames))
        for frames in SWEEP_FRAMES
        for threshold in SWEEP_THRESHOLDS
    ]


def best_operating_point(gates: Sequence[Gate]) -> Gate | None:
    """Return the operating point of highest recall with at most 5 % false positives.

    None if nothing is recognised at any of these. Ties go to the fewest false positives, then to points
    that the episodes are long enough for, then to the strictest.
    """

    def merit(gate: Gate) -> tuple[int, int, bool, SuccessCriterion]:
        return gate.recall.k, -gate.false_positives.k, not gate.repeats_last, gate.criterion

    allowed = [
        gate
        for gate in gates
        if gate.recall.k and gate.false_positives.k <= MAX_FALSE_POSITIVE_RATE * gate.false_positives.n
    ]
    return max(allowed, key=merit, default=None)


def gate_details(outcomes: Outcomes, gate: Gate) -> dict[str, Any]:
    """Return the gate of these outcomes for metrics.json: counts, rates and every episode's outcome."""
    return {
        "failures": gate.false_positives.n,
        "false_positives": gate.false_positives.k,
        "successes": gate.recall.n,
        "true_positives": gate.recall.k,
        **gate.as_json(),
        "episodes": outcomes.episodes.tolist(),
        "predicted_success": outcomes.predicted_success(gate.criterion).tolist(),
        "recorded_success": outcomes.success.tolist(),
    }


def precision_recall_f1(predicted: np.ndarray, target: np.ndarray) -> dict[str, Estimate]:
    """Pool (E, …) bool over everything; the intervals resample episodes."""
    axes = tuple(range(1, predicted.ndim))
    hits, positives, targets = (mask.sum(axes) for mask in (predicted & target, predicted, target))
    return {
        "precision": Estimate.ratio(hits, positives),
        "recall": Estimate.ratio(hits, targets),
        "f1": Estimate.ratio(2 * hits, positives + targets),
    }


def done_delay(outcomes: Outcomes, criterion: SuccessCriterion) -> np.ndarray:
    """Return the frames from the recorded to the predicted first success, NaN unless both exist. (E,)"""
    begin = outcomes.first_predicted_success(criterion)
    return np.where((begin >= 0) & outcomes.success, begin - outcomes.done.argmax(1), np.nan)


def done_log_loss(outcomes: Outcomes) -> Estimate:
    """Return the mean negative log-likelihood of the recorded outcome in nats a frame, at no threshold."""
    frames = ~np.isnan(outcomes.probability)
    likelihood = np.where(outcomes.done, outcomes.probability, 1 - outcomes.probability)
    losses = np.where(frames, -np.log(np.clip(likelihood, MIN_PROBABILITY, 1)), 0)
    return Estimate.ratio(losses.sum(1), frames.sum(1))


def done_accuracy(outcomes: Outcomes, criterion: SuccessCriterion) -> dict[str, Estimate]:
    """Measure the done signal: `done_*` over frames, `episode_*` as the environment ends episodes, delay.

    outcomes: with success as the model was taught it (`Outcomes.as_taught`).
    """
    fired = outcomes.probability >= criterion.threshold
    predicted = outcomes.predicted_success(criterion)
    per_frame = precision_recall_f1(fired, outcomes.done)
    per_episode = precision_recall_f1(predicted, outcomes.success)
    delay = done_delay(outcomes, criterion)
    return {
        **{f"done_{name}": estimate for name, estimate in per_frame.items()},
        **{f"episode_{name}": estimate for name, estimate in per_episode.items()},
        "done_log_loss": done_log_loss(outcomes),
        "done_delay_frames": Estimate.mean(delay),
        "done_distance_frames": Estimate.mean(np.abs(delay)),
    }
