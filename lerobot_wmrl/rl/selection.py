"""Which checkpoint is the best: success on seeds that neither training nor evaluation uses."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from lerobot.common.train_utils import get_step_checkpoint_dir

from lerobot_wmrl.common.checkpoints import BEST_CHECKPOINT_LINK, link_checkpoint
from lerobot_wmrl.common.distributed import rank_and_size
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.agreement import Evaluated
from lerobot_wmrl.rl.callbacks import REAL_STEPS, Record
from lerobot_wmrl.rl.policy_gradient import TrainingStopped

REAL, IMAGINED = "real", "imagined"

Measure = Callable[[], Evaluated]
"""Success of the policy as it is, with the actions it would take in earnest."""


class Selection:
    """Measures the policy at intervals and points `checkpoints/best` at the best checkpoint so far.

    Args:
        freq: iterations between two measurements; the first is before any update, the last after all.
        total: iterations of the training.
        measures: of success, `real` and `imagined`; real success decides where it is measured.
        output_dir: of the training.
    """

    name = "selection"

    def __init__(self, freq: int, total: int, measures: Mapping[str, Measure], output_dir: Path) -> None:
        self.freq, self.total, self.measures, self.output_dir = freq, total, measures, output_dir
        self.judge = REAL if REAL in measures else IMAGINED

    def due(self, iteration: int) -> bool:
        return iteration % self.freq == 0 or iteration == self.total

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """`real` and `imagined`: how many episodes of how many succeeded."""
        found = {place: measure() for place, measure in self.measures.items()}
        shares = {
            place: Proportion(sum(each.successes), len(each.successes)) for place, each in found.items()
        }
        told = ", ".join(f"{place} success {share}" for place, share in shares.items())
        logging.info("Iteration %d: %s", iteration, told)
        steps = found[REAL].steps if REAL in found else 0
        return {**{place: share.as_json() for place, share in shares.items()}, REAL_STEPS: steps}

    def apply(self, records: Mapping[int, Record]) -> None:
        """Point at the best, the earlier of equals. TrainingStopped where imagined and real success part."""
        best = best_iteration(records, self.judge)
        checkpoint = get_step_checkpoint_dir(self.output_dir, self.total, best)
        if rank_and_size()[0] == 0:
            link_checkpoint(checkpoint, BEST_CHECKPOINT_LINK)
        latest = max(records)
        if parted(records[best], records[latest]):
            before, now = (
                " and ".join(f"{place} {measured(records[at], place)}" for place in (IMAGINED, REAL))
                for at in (best, latest)
            )
            raise TrainingStopped(
                f"iteration {latest}: real success has fallen while imagined success has not: {now}, after "
                f"{before} at iteration {best}. The policy has learnt what only the world model believes. "
                f"{checkpoint} is the best one; teach the world model what this policy does (--dyna.rounds), "
                "hold the policy nearer (--algorithm.reference_coefficient), or stop earlier (--iterations)"
            )


def measured(record: Record, place: str) -> Proportion:
    """Episodes that succeeded there."""
    return Proportion(record[place]["k"], record[place]["n"])


def best_iteration(records: Mapping[int, Record], place: str) -> int:
    """Where most succeeded; the earlier of equals, which is nearer to the cloned policy."""
    return max(sorted(records), key=lambda iteration: measured(records[iteration], place).share)


def parted(best: Record, latest: Record) -> bool:
    """Whether real success has fallen since, the intervals being apart, and imagined success has not."""
    if any(place not in record for place in (REAL, IMAGINED) for record in (best, latest)):
        return False
    fallen = measured(latest, REAL).interval[1] < measured(best, REAL).interval[0]
    return fallen and measured(latest, IMAGINED).share >= measured(best, IMAGINED).share
