"""Predicted and recorded success of episodes, frame by frame: what the gate and the judge count."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from lerobot_wmrl.common.constants import KINDS, PLAY, START_KIND, START_TASK, TASK_NAMES
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.statistics import roc_auc
from lerobot_wmrl.common.success_criterion import SuccessCriterion, first_run
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frame_cache import cached_features
from lerobot_wmrl.evaluation.replay import EpisodeReplay, Recording, in_batches
from lerobot_wmrl.world_models.checkpoint import check_dataset
from lerobot_wmrl.world_models.configuration_world_model import WorldModelConfig
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.success import PredictedSuccess

MOST_TASKS: Final = 20
"""More instructions than these are taken for other words of the same tasks."""

MOST_DELAY: Final = 2
"""Frames by which a success may be predicted late and counts, although its episode ends."""


class PredictedDone(NamedTuple):
    """One episode of T actions: predicted done_probability (T,) and recorded done (T,)."""

    episode: int
    done_probability: Tensor
    done: np.ndarray


@dataclass(frozen=True)
class Outcomes:
    """Predicted and recorded success of E episodes.

    Args:
        episodes: their indices (E,).
        probability: predicted done probability after each action (E, T), NaN after the end.
        done: recorded success after each action (E, T).
        held: median of the frames for which successes hold at the end of their episodes. It is that of all
            episodes, also of a part of them.
        cut: episodes of which only the first frames are looked at, (E,) bool; by default none.
        limit: frames that an episode may have, None if as many as it likes: no success can hold beyond.
    """

    episodes: np.ndarray
    probability: np.ndarray
    done: np.ndarray
    held: float | None = None
    cut: np.ndarray = field(default_factory=lambda: np.array(False))
    limit: int | None = None

    def __post_init__(self) -> None:
        if self.held is None:
            object.__setattr__(self, "held", self._median_held())
        object.__setattr__(self, "cut", np.broadcast_to(self.cut, len(self.episodes)))

    def _median_held(self) -> float:
        """Return infinity without a success; one that ends before its episode counts as infinite too."""
        held = []
        for row, end in zip(self.done[self.success], self.length[self.success], strict=True):
            backwards = row[:end][::-1]
            frames = end if backwards.all() else int(np.argmin(backwards))
            held.append(frames or np.inf)
        return float(np.median(held)) if held else np.inf

    @classmethod
    def stack(cls, predictions: Iterable[EpisodeReplay | PredictedDone]) -> "Outcomes":
        """Stack predictions of single episodes, in the order of the episodes."""
        rows = sorted(predictions, key=lambda each: each.episode)
        shape = len(rows), max(len(each.done) for each in rows)
        probability, done = np.full(shape, np.nan), np.zeros(shape, bool)
        for row, each in enumerate(rows):
            probability[row, : len(each.done)] = each.done_probability.cpu().numpy()
            done[row, : len(each.done)] = each.done
        return cls(np.array([each.episode for each in rows]), probability, done)

    def attempts(self, table: EpisodeTable) -> "Outcomes":
        """Leave out play, which attempts no task, unless there is nothing else."""
        kept = table.column(START_KIND)[self.episodes] != KINDS.index(PLAY)
        return self.where(kept) if kept.any() else self

    def where(self, kept: np.ndarray) -> "Outcomes":
        """Return the episodes where `kept` (E,) is True."""
        return Outcomes(
            self.episodes[kept],
            self.probability[kept],
            self.done[kept],
            self.held,
            self.cut[kept],
            self.limit,
        )

    def within(self, frames: int | None) -> "Outcomes":
        """Return the outcomes by the first frames of every episode, by all if `frames` is None. A later
        success does not count, and neither does what is predicted for later frames."""
        if frames is None:
            return self
        return Outcomes(
            self.episodes,
            self.probability[:, :frames],
            self.done[:, :frames],
            self.held,
            self.cut | (self.length > frames),
            frames,
        )

    def as_taught(self, table: EpisodeTable) -> "Outcomes":
        """Return the outcomes with success where models learn it, also where that is inferred
        (`EpisodeTable.success_target`): frame by frame, that is what they predict."""
        done = self.done.copy()
        for row, (rows, end) in enumerate(zip(table.rows(self.episodes), self.length, strict=True)):
            done[row, :end] = table.success_target[rows][:end]
        return replace(self, done=done)

    @property
    def length(self) -> np.ndarray:
        """Actions of each episode, (E,)."""
        return np.sum(~np.isnan(self.probability), axis=1)

    @property
    def success(self) -> np.ndarray:
        """Recorded success of each episode, (E,) bool."""
        return np.any(self.done, axis=1)

    def first_predicted_success(self, criterion: SuccessCriterion) -> np.ndarray:
        """Return the step at which the model first predicts success, −1 if never. (E,)"""
        return criterion.first_met(self.padded_probability(criterion.frames))

    def predicted_success(self, criterion: SuccessCriterion) -> np.ndarray:
        """Return whether the model predicts success for each episode, (E,) bool."""
        return self.first_predicted_success(criterion) >= 0

    def cut_short(self, frames: int) -> np.ndarray:
        """Mark episodes that end with a success that has held for fewer than `frames` frames. (E,)"""
        at_end = self.done[np.arange(len(self.done)), self.length - 1]
        return at_end & (first_run(self.done, frames) < 0)

    def ends_at_success(self, frames: int) -> bool:
        """Whether successes mostly end before a model can predict them for `frames` frames: before they have
        held so long, as in environments that end at the first success, or hardly later, so that one that is
        seen `MOST_DELAY` frames late could not count."""
        assert self.held is not None
        return self.held < frames + MOST_DELAY

    def padded_probability(self, frames: int) -> np.ndarray:
        """Return the predicted probabilities. (E, T')

        Where episodes end at success, the prediction for the last frame is repeated, in failures as well, so
        that it can hold for `frames` frames; not in episodes that go on, and not beyond the `limit`, at which
        an imagined episode ends too.
        """
        if not self.ends_at_success(frames):
            return self.probability
        probability = np.pad(self.probability, ((0, 0), (0, frames - 1)), constant_values=np.nan)
        for row, end in enumerate(self.length):
            if not self.cut[row]:
                probability[row, end : end + frames - 1] = probability[row, end - 1]
        return probability[:, : self.limit]

    def scores(self, frames: int) -> np.ndarray:
        """Return the highest threshold at which the model predicts success for `frames` frames. (E,)

        −∞ for an episode that is shorter.
        """
        probability = self.padded_probability(frames)
        if probability.shape[1] < frames:
            return np.full(len(probability), -np.inf)
        probability = np.where(np.isnan(probability), -np.inf, probability)
        return sliding_window_view(probability, frames, axis=1).min(-1).max(1)

    def auc(self, frames: int) -> float:
        """Return how often a success scores higher than a failure, `roc_auc`."""
        return roc_auc(self.scores(frames), self.success)


def labelled_recording(model: ActionWorldModelRewardModel, table: EpisodeTable) -> Recording:
    """Return the recording of rollouts that the model can replay and whose success is recorded.

    Raises:
        FieldError: the dataset does not fit the model, or has no labels of success.
    """
    check_labelled(model.config, table)
    return Recording.read(table, model)


def check_labelled(config: WorldModelConfig, table: EpisodeTable) -> None:
    """Raise FieldError for rollouts that a world model cannot replay, or whose success is not recorded."""
    check_dataset(config, table.dataset.meta)
    if not table.has_labels:
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            "has neither next.success nor next.done, which say whether success holds",
            "use rollouts with labels",
        )


def predict_outcomes(model: ActionWorldModelRewardModel, recording: Recording) -> Outcomes:
    """Predict the outcome of every episode but play, open loop."""
    return Outcomes.stack(predict_done(model, recording)).attempts(recording.table)


def predict_done(model: ActionWorldModelRewardModel, recording: Recording) -> Iterator[PredictedDone]:
    """Predict done for all episodes open loop, short ones first, without drawing frames."""
    device, length = model.device, recording.table.length
    recording.frames.fill(recording.table.start)
    for batch in in_batches(np.argsort(length, kind="stable")):
        actions = recording.actions(batch, int(length[batch].max()), device)
        ahead = model.open_loop(recording.starts(model, batch), actions, with_tokens=False)
        probability = ahead.done_logit.sigmoid()
        for row, episode in enumerate(batch.tolist()):
            done = recording.table.done[recording.rows(episode)]
            yield PredictedDone(episode, probability[row, : len(done)], done)


@torch.no_grad()
def seen_outcomes(
    model: ActionWorldModelRewardModel, recording: Recording, episodes: Sequence[int] | np.ndarray
) -> Outcomes | None:
    """Judge recorded frames, not imagined ones, by the success classifier that the model has success from.

    Of every episode the first frames count, as many as the model's clips have; what succeeds later has not
    succeeded in them.

    Returns:
        Their outcomes as the gate has them; None for a model without such a classifier, or without labels.
    """
    done, table = model.dynamics.network.done, recording.table
    if not isinstance(done, PredictedSuccess) or not table.has_labels:
        return None
    features = cached_features(table.dataset, model.config.tokenizer.camera_keys, model.tokenizer)
    features.fill(table.row_numbers(episodes))

    def judged(episode: int) -> PredictedDone:
        rows = recording.rows(episode)
        seen = torch.from_numpy(np.array(features[rows])).to(model.device)
        probability = done.head(seen, model.instruction_weights([table.instructions[episode]], 1)).sigmoid()
        return PredictedDone(episode, torch.cat([probability[1:], probability[-1:]]), table.done[rows])

    return Outcomes.stack(judged(int(episode)) for episode in episodes).within(model.config.clip_length)


def by_task(outcomes: Outcomes, table: EpisodeTable) -> dict[str, Outcomes]:
    """Return the outcomes of each task in the dataset: by its column `start.task`, else by the instructions;
    none if there is but one instruction, or more than `MOST_TASKS`."""
    tasks = table.column(START_TASK)[outcomes.episodes]
    if (tasks >= 0).any():
        return {TASK_NAMES[task]: outcomes.where(tasks == task) for task in np.unique(tasks[tasks >= 0])}
    instructions = np.array([table.instructions[each] for each in outcomes.episodes])
    distinct = np.unique(instructions).tolist()
    if not 1 < len(distinct) <= MOST_TASKS:
        return {}
    return {each: outcomes.where(instructions == each) for each in distinct}
