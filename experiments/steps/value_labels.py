"""Label every frame with its advantage, for the two ways of cloning that use more than successes.

    python -m experiments.steps.value_labels outputs/dataset --weights=outputs/weights.parquet
    python -m experiments.steps.value_labels outputs/dataset --conditioned=outputs/conditioned

A value model predicts success from single frames. The advantage of an action is how far the prediction rises
within `--steps` frames; at an episode's end the outcome, 1 or 0, takes the prediction's place:

    A_t = V_{t+n} − V_t

Among the actions of rollouts, a share `--quantile` has an advantage below the threshold: these are negative.
The others and all actions of demonstrations are positive.

`--weights` is for advantage-weighted cloning (Peng et al. 2019; Wang et al. 2020) by LeRobot's RA-BC:
`lerobot-train --sample_weighting.type=rabc --sample_weighting.progress_path=FILE --sample_weighting.kappa=κ`.
The file holds sums of advantages above the threshold, so that the progress δ from one frame to the next is
A_t − threshold. LeRobot's weight is 0 for δ < 0, 1 for δ > κ and in between, with δ's mean μ and std σ,
clip(½ + (δ − μ) / 4σ, 0, 1). A small κ keeps positive actions alone. With κ = 2 and `--quantile=0` the weight
rises linearly with the advantage. An episode's last frame has no progress: δ = 0.

`--conditioned` is for an advantage-conditioned policy (RECAP, Physical Intelligence 2025): a copy of the
dataset in which the instruction of negative actions ends in " (advantage: negative)". The plain instruction
then asks for positive actions.
"""

import argparse
import shutil
import sys
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import load_info, write_info, write_tasks
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from experiments.steps.value_model import cross_fitted_values, log_loss
from lerobot_wmrl.common.constants import KINDS, START_KIND
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import whole_folder
from lerobot_wmrl.common.statistics import roc_auc
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, parquet_files, read_episodes

STEPS: Final = 10
QUANTILE: Final = 0.6

BEST_ADVANTAGE: Final = 1.0
"""Advantage of demonstrations: the largest there is, from certain failure to success."""

NEGATIVE: Final = " (advantage: negative)"
"""End of a negative action's instruction."""


def read_labelled(root: Path) -> EpisodeTable:
    """Read the episodes of a dataset that tells successes from failures. FieldError if it does not."""
    table = read_episodes(open_dataset(root))
    if not table.has_labels:
        raise FieldError("root", root, "has no column next.success", "add it, for failures too")
    if len(outcomes := set(table.success.tolist())) < 2:
        outcome = "succeeds" if outcomes == {True} else "fails"
        raise FieldError("root", root, f"every episode {outcome}", "add rollouts with the other outcome")
    return table


def demonstrations(table: EpisodeTable) -> np.ndarray:
    """Mark the successes that were not recorded from a policy, by the recorder's column start.kind. (E,)"""
    kind = table.column(START_KIND)
    return (kind >= 0) & (kind != KINDS.index("policy")) & table.success


def advantages(values: np.ndarray, table: EpisodeTable, steps: int) -> np.ndarray:
    """Return V_{t+n} − V_t, with the outcome in the place of V where an episode ends before. (N,)

    Args:
        values: probability of success at each frame. (N,)
        table: the episodes.
        steps: n.
    """
    later = np.repeat(table.success.astype(float), table.length)
    for start, end in zip(table.start, table.start + table.length, strict=True):
        later[start : max(start, end - steps)] = values[start + steps : end]
    return later - values


def relative_advantages(values: np.ndarray, table: EpisodeTable, steps: int, quantile: float) -> np.ndarray:
    """Return advantages above the threshold, a quantile of those of rollouts; demonstrations have the best.

    Args:
        values: probability of success at each frame. (N,)
        table: the episodes.
        steps: frames from an action to the frame that judges it.
        quantile: share of the rollouts' actions with an advantage below the threshold.

    Returns:
        Negative for negative actions. (N,)
    """
    demonstrated = np.repeat(demonstrations(table), table.length)
    found = advantages(values, table, steps)
    threshold = np.quantile(found[~demonstrated], quantile)
    return np.where(demonstrated, BEST_ADVANTAGE, found) - threshold


def write_weights(path: Path, table: EpisodeTable, relative: np.ndarray) -> None:
    """Write relative advantages (N,) as LeRobot's RA-BC reads them: as progress between frames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    progress = np.concatenate([[0.0], relative.cumsum()[:-1]])
    episode = np.repeat(np.arange(len(table.start)), table.length)
    columns = {"index": np.arange(len(relative)), "episode_index": episode, "progress_sparse": progress}
    pd.DataFrame(columns).to_parquet(path, index=False)


def write_conditioned(folder: Path, table: EpisodeTable, negative: np.ndarray) -> LeRobotDataset:
    """Copy a dataset, with NEGATIVE behind the instruction of the frames where `negative` (N,) is True.

    LeRobot's own `modify_tasks` gives an episode one instruction, this gives one to each frame.
    """
    with whole_folder(folder) as partial:
        shutil.copytree(table.dataset.root, partial)
        plain = table.dataset.meta.tasks[["task_index"]]
        suffixed = plain.rename(lambda task: task + NEGATIVE) + len(plain)
        for path in parquet_files(partial):
            rows = pq.read_table(path)
            task = rows["task_index"].to_numpy() + len(plain) * negative[rows["index"].to_numpy()]
            column = rows.schema.get_field_index("task_index")
            pq.write_table(rows.set_column(column, rows.schema.field(column), pa.array(task)), path)
        mixed = np.logical_or.reduceat(negative, table.start)
        for path in sorted((partial / "meta" / "episodes").rglob("*.parquet")):
            rows = pd.read_parquet(path)
            rows["tasks"] = [
                [*tasks, *(task + NEGATIVE for task in tasks if mixed[episode])]
                for episode, tasks in zip(rows["episode_index"], rows["tasks"], strict=True)
            ]
            rows.to_parquet(path, index=False)
        write_tasks(pd.concat([plain, suffixed]), partial)
        info = load_info(partial)
        info.total_tasks = 2 * len(plain)
        write_info(info, partial)
    return open_dataset(folder)


def describe(values: np.ndarray, relative: np.ndarray, table: EpisodeTable) -> str:
    """Say how well the values predict rollouts' outcomes, and which actions are positive."""
    rollout = ~np.repeat(demonstrations(table), table.length)
    outcome = np.repeat(table.success, table.length)
    known, constant = outcome[rollout], np.full(rollout.sum(), outcome[rollout].mean())
    positive = relative >= 0
    return (
        f"held-out rollouts: AUC {roc_auc(values[rollout], known.astype(bool)):.3f}, "
        f"log-loss {log_loss(values[rollout], known):.3f} (of a constant {log_loss(constant, known):.3f})\n"
        f"positive actions: {positive[rollout & outcome].mean():.0%} in successful rollouts, "
        f"{positive[rollout & ~outcome].mean():.0%} in failures"
    )


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="a LeRobotDataset of demonstrations and labelled rollouts")
    parser.add_argument("--weights", type=Path, help="file to write for LeRobot's sample weighting")
    parser.add_argument("--conditioned", type=Path, help="folder to write the copied dataset to")
    parser.add_argument("--steps", type=int, default=STEPS, help="frames from action to judgement")
    parser.add_argument("--quantile", type=float, default=QUANTILE, help="negative share of rollouts")
    parser.add_argument("--seed", type=int, default=0, help="of folds, weights and batches")
    return parser


def check_arguments(given: argparse.Namespace) -> None:
    """Raise FieldError for an argument that cannot be."""
    outputs = {"weights": given.weights, "conditioned": given.conditioned}
    if not any(outputs.values()):
        raise FieldError("weights", None, "nothing to write", "give `weights`, `conditioned` or both")
    for field, path in outputs.items():
        if path is not None and path.exists():
            raise FieldError(field, path, "exists", "remove it or choose another path")
    if given.steps < 1:
        raise FieldError("steps", given.steps, "must be at least 1")
    if not 0 <= given.quantile < 1:
        raise FieldError("quantile", given.quantile, "must be from 0 to below 1")


def label(given: argparse.Namespace) -> None:
    """Train the value model, print how good it is, and write what was asked for."""
    check_arguments(given)
    table = read_labelled(given.root)
    values = cross_fitted_values(table, given.seed)
    relative = relative_advantages(values, table, given.steps, given.quantile)
    print(describe(values, relative, table))
    if given.weights:
        write_weights(given.weights, table, relative)
    if given.conditioned:
        write_conditioned(given.conditioned, table, relative < 0)


def main() -> None:
    """Entry point."""
    try:
        label(make_parser().parse_args())
    except ValueError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
