"""Selection of the best checkpoint by its success on seeds that neither training nor evaluation uses."""

import logging
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

from lerobot_wmrl.common.checkpoints import BEST_CHECKPOINT_LINK, checkpoint_dir, link_checkpoint
from lerobot_wmrl.common.distributed import is_first_process
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.policy_rollouts import PolicyEvaluation
from lerobot_wmrl.rl.callbacks import REAL_STEPS, Record

REAL, IMAGINED = "real", "imagined"

Measure = Callable[[], PolicyEvaluation]
"""Plays episodes with the current policy, without exploration."""


class Selection:
    """Measures success at intervals and points `checkpoints/best` at the best checkpoint so far.

    Args:
        freq: iterations between two measurements; one is before the first update and one after the last.
        total: iterations of the training.
        measures: functions that measure success, `real` (outside the world model) and `imagined`. `real`
            decides if it is given.
        output_dir: the training's output folder.
        refreshed: iterations after which a Dyna round replaces the world model. Success in imagination is
            compared within one world model alone.
    """

    name = "selection"

    def __init__(
        self,
        freq: int,
        total: int,
        measures: Mapping[str, Measure],
        output_dir: Path,
        refreshed: Collection[int] = (),
    ) -> None:
        self.freq, self.total, self.measures, self.output_dir = freq, total, measures, output_dir
        self.refreshed = refreshed
        self.judge = REAL if REAL in measures else IMAGINED

    def due(self, iteration: int) -> bool:
        """Return whether to measure after so many iterations."""
        return iteration % self.freq == 0 or iteration == self.total

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """Return the proportion of successes, `real` and `imagined`."""
        results = {place: measure() for place, measure in self.measures.items()}
        shares = {place: Proportion.of(each.successes) for place, each in results.items()}
        summary = ", ".join(f"{place} success {share}" for place, share in shares.items())
        logging.info("Iteration %d: %s", iteration, summary)
        steps = results[REAL].steps if REAL in results else 0
        return {**{place: share.as_json() for place, share in shares.items()}, REAL_STEPS: steps}

    def apply(self, records: Mapping[int, Record]) -> None:
        """Point `checkpoints/best` at the best checkpoint, or the earliest of equally good ones.

        Raises:
            TrainingStopped: real success has fallen while imagined success has not.
        """
        latest, comparable = max(records), in_one_world_model(records, self.refreshed)
        checkpoint = best_checkpoint(self.output_dir, self.total, records, self.judge, self.refreshed)
        if is_first_process():
            link_checkpoint(checkpoint, BEST_CHECKPOINT_LINK)
        earlier = best_iteration(comparable, self.judge)
        if diverged(records[earlier], records[latest]):
            before, now = (
                " and ".join(f"{place} {success(records[at], place)}" for place in (IMAGINED, REAL))
                for at in (earlier, latest)
            )
            raise TrainingStopped(
                f"iteration {latest}: real success has fallen while imagined success has not: {now}, after "
                f"{before} at iteration {earlier}. The policy exploits errors of the world model. "
                f"{checkpoint} is the best one; train the world model on what this policy does "
                "(`dyna.rounds`), keep the policy nearer to the SFT policy "
                "(`algorithm.reference_coefficient` of PPO and GRPO), or stop earlier (`iterations`)"
            )


def in_one_world_model(records: Mapping[int, Record], refreshed: Collection[int]) -> dict[int, Record]:
    """Return the records since the last Dyna round: success in imagination is compared among these alone."""
    since = max((each for each in refreshed if each <= max(records)), default=0)
    return {iteration: record for iteration, record in records.items() if iteration >= since}


def best_checkpoint(
    output_dir: Path, total: int, records: Mapping[int, Record], judge: str, refreshed: Collection[int]
) -> Path:
    """Return the checkpoint with most successes where `judge` says, `real` or `imagined`."""
    comparable = records if judge == REAL else in_one_world_model(records, refreshed)
    return checkpoint_dir(output_dir, total, best_iteration(comparable, judge))


def success(record: Record, place: str) -> Proportion:
    """Return the proportion of successes in a record."""
    return Proportion.from_json(record[place])


def best_iteration(records: Mapping[int, Record], place: str) -> int:
    """Return the iteration with most successes; of equal ones the earliest, nearest to the SFT policy."""
    return max(sorted(records), key=lambda iteration: success(records[iteration], place).share)


def diverged(best: Record, latest: Record) -> bool:
    """Return whether real success has fallen, so far that the confidence intervals do not overlap, while
    imagined success has not."""
    if any(place not in record for place in (REAL, IMAGINED) for record in (best, latest)):
        return False
    fallen = success(latest, REAL).interval[1] < success(best, REAL).interval[0]
    return fallen and success(latest, IMAGINED).share >= success(best, IMAGINED).share
