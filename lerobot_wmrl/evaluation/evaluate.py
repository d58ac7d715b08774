"""One pass over real episodes: replay each, measure it, keep the numbers and let the frames go."""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_wmrl.common.constants import KINDS, PLAY
from lerobot_wmrl.data.frames import NO_CONTEXT
from lerobot_wmrl.evaluation.accuracy import EpisodeAccuracy, measure
from lerobot_wmrl.evaluation.alexnet_lpips import cached_lpips
from lerobot_wmrl.evaluation.gate import Outcomes
from lerobot_wmrl.evaluation.replay import EpisodeReplay, Source, replay_episodes
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


@dataclass(frozen=True)
class Evaluation:
    """accuracy of every episode, in order; attempts: those that attempt the task; outcomes: of these, none if
    the dataset does not say; shown: the replays of the shortest success and the shortest failure, by name."""

    accuracy: list[EpisodeAccuracy]
    attempts: np.ndarray
    outcomes: Outcomes
    shown: dict[str, EpisodeReplay]


def evaluate(model: ActionWorldModelRewardModel, source: Source, episodes: np.ndarray) -> Evaluation:
    """Replay and measure. ValueError if there is nothing to predict, or a number is not finite."""
    if source.table.length[episodes].max() < 2:
        raise ValueError(
            f"dataset.root={source.table.dataset.root}: every chosen episode has a single frame; there is "
            "nothing to predict. Use a dataset with longer episodes"
        )
    lpips = cached_lpips(model.state_mean.device)
    accuracy, runs = [], []
    shown: dict[str, EpisodeReplay] = {}
    for run in replay_episodes(model, source, episodes):
        accuracy.append(measure(model, source, run, lpips))
        runs.append(replace(run, tokens=run.tokens.new_empty(0), context=NO_CONTEXT))
        if source.table.kind[run.episode] != KINDS.index(PLAY) and len(run.done) > 1:
            shown.setdefault("success" if run.done.any() else "failure", run)
    accuracy.sort(key=lambda episode: episode.episode)
    outcomes = Outcomes.of(runs).attempts(source.table)
    known = outcomes.where(np.full(len(outcomes.episodes), source.table.done_known))
    return Evaluation(accuracy, outcomes.episodes, known, shown)
