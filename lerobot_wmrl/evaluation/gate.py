"""The gate: of episodes that failed in reality, how many does the model, replayed open loop, believe in?

It decides whether a policy may be trained inside the model, and is meant for real rollouts of policies that
the model was not trained on.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import mannwhitneyu
from torch import Tensor

from lerobot_wmrl.common.constants import KINDS, PLAY, TASKS
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.compatibility import check_dataset
from lerobot_wmrl.data.episode_table import EpisodeTable, open_dataset, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.evaluation.replay import LONGEST, EpisodeReplay, Source, in_batches
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.open_loop import open_loop

MOST_FALSE = 0.05
"""Share of the failures that may be called successes."""

FEWEST_RECOGNISED = 0.9
"""Share of the successes that must be found."""

SWEEP_THRESHOLDS = tuple(round(0.3 + 0.05 * step, 2) for step in range(14))
SWEEP_FRAMES = tuple(range(1, 7))


class Judged(NamedTuple):
    """An episode of T actions: done_probability (T,) as the model has it, done (T,) really."""

    episode: int
    done_probability: Tensor
    done: np.ndarray


@dataclass(frozen=True)
class Outcomes:
    """E real episodes as a model sees them.

    episodes (E,); probability (E, T) of success after each action, NaN after the end; done (E, T), real.
    """

    episodes: np.ndarray
    probability: np.ndarray
    done: np.ndarray

    @classmethod
    def of(cls, judged: Iterable[EpisodeReplay | Judged]) -> "Outcomes":
        """From replays or verdicts, by episode."""
        runs = sorted(judged, key=lambda run: run.episode)
        shape = len(runs), max(len(run.done) for run in runs)
        probability, done = np.full(shape, np.nan), np.zeros(shape, bool)
        for row, run in enumerate(runs):
            probability[row, : len(run.done)] = run.done_probability.cpu().numpy()
            done[row, : len(run.done)] = run.done
        return cls(np.array([run.episode for run in runs]), probability, done)

    def attempts(self, table: EpisodeTable) -> "Outcomes":
        """Without play, which attempts nothing; all of them, if there is nothing else."""
        kept = table.kind[self.episodes] != KINDS.index(PLAY)
        return self.where(kept) if kept.any() else self

    def where(self, kept: np.ndarray) -> "Outcomes":
        """Some of the episodes: kept (E,)."""
        return Outcomes(self.episodes[kept], self.probability[kept], self.done[kept])

    @property
    def success(self) -> np.ndarray:
        """Really. (E,)"""
        return np.any(self.done, axis=1)

    def first_predicted_success(self, threshold: float, frames: int) -> np.ndarray:
        """Where the model first sees success, as the environment would end an episode: the first of `frames`
        consecutive frames at `threshold`, −1 if there is none. (E,)"""
        return first_run(self.probability >= threshold, frames)

    def scores(self, frames: int) -> np.ndarray:
        """The highest threshold at which the model sees success for `frames` frames in a row. (E,)"""
        probability = np.nan_to_num(self.probability)
        if probability.shape[1] < frames:
            return np.zeros(len(probability))
        return np.lib.stride_tricks.sliding_window_view(probability, frames, axis=1).min(-1).max(1)

    def auc(self, frames: int) -> float:
        """Probability that a success scores higher than a failure, 0.5 by chance, whatever the threshold.
        NaN without both."""
        scores, success = self.scores(frames), self.success
        if success.all() or not success.any():
            return math.nan
        above = mannwhitneyu(scores[success], scores[~success]).statistic
        return float(above / (success.sum() * (~success).sum()))


@dataclass(frozen=True)
class Gate:
    """False successes among the failures, and successes that were recognised, at one operating point; and
    how well the two are told apart at any threshold, `Outcomes.auc`. Successes cut short were recorded for
    fewer than `frames` frames: nobody can recognise them here."""

    threshold: float
    frames: int
    false_positives: Proportion
    recall: Proportion
    cut_short: int
    auc: float

    @property
    def passed(self) -> bool:
        """At most 5 % of the failures called success, at least 90 % of the successes found."""
        return self.false_positives.share <= MOST_FALSE and self.recall.share >= FEWEST_RECOGNISED

    def as_json(self) -> dict[str, Any]:
        return {
            "done_threshold": self.threshold,
            "done_frames": self.frames,
            "false_positive_rate": self.false_positives.as_json(),
            "recall": self.recall.as_json(),
            "successes_cut_short": self.cut_short,
            "auc": None if math.isnan(self.auc) else self.auc,
            "passed": self.passed,
        }


def success_gate(
    model: ActionWorldModelRewardModel, dataset_root: str | Path, threshold: float = 0.5, frames: int = 3
) -> Gate:
    """Replay every episode of a dataset of real rollouts and count. ValueError if the model cannot."""
    return gate_at(attempted(model, rollouts_for(model, dataset_root)), threshold, frames)


def rollouts_for(model: ActionWorldModelRewardModel, dataset_root: str | Path) -> Source:
    """A dataset of real rollouts to ask the model about. ValueError if it cannot replay them, or nobody knows
    which of them succeeded."""
    table = read_episodes(open_dataset(dataset_root))
    check_dataset(model.config, table.dataset.features)
    if not table.done_known:
        raise ValueError(
            f"dataset.root={dataset_root}: has neither next.success nor next.done, which say whether success "
            "holds; use rollouts with labels"
        )
    return Source(table, cached_frames(table.dataset, model.config.tokenizer.camera_keys))


def attempted(model: ActionWorldModelRewardModel, source: Source) -> Outcomes:
    """What the model makes of all episodes but play."""
    return Outcomes.of(judged_episodes(model, source)).attempts(source.table)


def judged_episodes(model: ActionWorldModelRewardModel, source: Source) -> Iterator[Judged]:
    """All episodes open loop, without pictures, short ones first."""
    device, length = model.state_mean.device, source.table.length
    for batch in in_batches(np.argsort(length, kind="stable")):
        tokens, context = source.starts(batch, model.tokenizer)
        state, depth = source.first_state(batch, device), source.first_depth(model, batch)
        actions = source.actions(batch, min(int(length[batch].max()), LONGEST), device)
        probability = open_loop(model, tokens, state, actions, context, depth).done_logit.sigmoid()
        for row, episode in enumerate(batch.tolist()):
            done = source.table.done[source.rows(episode)]
            yield Judged(episode, probability[row, : len(done)], done)


def gate_at(outcomes: Outcomes, threshold: float, frames: int) -> Gate:
    """Count at one operating point."""
    called, real = outcomes.first_predicted_success(threshold, frames) >= 0, outcomes.success
    return Gate(
        threshold,
        frames,
        Proportion(int((called & ~real).sum()), int((~real).sum())),
        Proportion(int((called & real).sum()), int(real.sum())),
        int((real & (first_run(outcomes.done, frames) < 0)).sum()),
        outcomes.auc(frames),
    )


def gates_by_task(outcomes: Outcomes, table: EpisodeTable, threshold: float, frames: int) -> dict[str, Gate]:
    """The gate of each task in the dataset, from the same replay; none if it does not say."""
    tasks = table.task[outcomes.episodes]
    return {
        TASKS[task]: gate_at(outcomes.where(tasks == task), threshold, frames)
        for task in np.unique(tasks[tasks >= 0])
    }


def sweep(outcomes: Outcomes) -> list[Gate]:
    """The gate at every operating point, from the same replay."""
    return [gate_at(outcomes, at, frames) for frames in SWEEP_FRAMES for at in SWEEP_THRESHOLDS]


def best_operating_point(gates: Sequence[Gate]) -> Gate | None:
    """Of those with at most 5 % false successes the one that recognises most; None if there is none.

    Among equals the fewest false successes, then the strictest.
    """

    def merit(gate: Gate) -> tuple[float, ...]:
        return gate.recall.k, -gate.false_positives.k, gate.threshold, gate.frames

    tolerable = [gate for gate in gates if gate.false_positives.share <= MOST_FALSE and gate.recall.n]
    return max(tolerable, key=merit, default=None)


def success_agreement(outcomes: Outcomes, threshold: float, frames: int) -> dict[str, Any]:
    """The gate at one operating point, in detail: counts, rates, and every episode's verdict."""
    gate = gate_at(outcomes, threshold, frames)
    return {
        "failures": gate.false_positives.n,
        "false_positives": gate.false_positives.k,
        "successes": gate.recall.n,
        "true_positives": gate.recall.k,
        **gate.as_json(),
        "episodes": outcomes.episodes.tolist(),
        "predicted_success": (outcomes.first_predicted_success(threshold, frames) >= 0).tolist(),
        "recorded_success": outcomes.success.tolist(),
    }


def first_run(fired: np.ndarray, frames: int) -> np.ndarray:
    """Where the first run of `frames` consecutive True begins, −1 if there is none. (E, T) → (E,)"""
    count, begin = np.zeros(fired.shape[0], int), np.full(fired.shape[0], -1)
    for step, column in enumerate(fired.T):
        count = np.where(column, count + 1, 0)
        begin = np.where((begin < 0) & (count >= frames), step - frames + 1, begin)
    return begin
