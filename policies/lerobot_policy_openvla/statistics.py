"""Statistics of a dataset's actions, and how they turn normalised actions into the robot's.

OpenVLA maps the 1st and 99th percentile of each component to −1 and 1. Components outside its `mask`, the
gripper, are left as they are.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from lerobot.utils.constants import ACTION

from lerobot_wmrl.data.episodes import parquet_files

NormStats = dict[str, Any]
"""OpenVLA's: dataset → {"action": {"q01", "q99", "mask", …}, …}, lists of one number a component."""

GRIPPER = "gripper"
QUANTILES = ("q01", "q99")
USED = (*QUANTILES, "mask")


def adopt_statistics(config: Any, dataset_meta: Any) -> None:
    """A policy is about to learn from a dataset: keep its statistics under its name, and apply them.

    LeRobot gives the statistics in `dataset_meta` to the processors after it has built the policy, also to
    those of a checkpoint, so that is where they are replaced as well.
    """
    quantiles = {name: np.asarray(value).tolist() for name, value in dataset_meta.stats[ACTION].items()}
    entry = dataset_statistics(dataset_meta) or {"action": quantiles}
    config.norm_stats = {**config.norm_stats, dataset_meta.repo_id: entry}
    config.unnorm_key = dataset_meta.repo_id
    dataset_meta.stats[ACTION] = {**dataset_meta.stats[ACTION], **lerobot_statistics(entry["action"])}


def dataset_statistics(dataset_meta: Any) -> NormStats | None:
    """What OpenVLA's training derives from a dataset's actions; None if they are not on disk.

    LeRobot's own quantiles are means over the episodes' quantiles, which is something else.
    """
    files = parquet_files(Path(dataset_meta.root))
    if not files:
        return None
    actions = np.concatenate([read_actions(file) for file in files])
    names = component_names(dataset_meta.features[ACTION].get("names"), actions.shape[1])
    return {
        "action": action_statistics(actions, names),
        "num_transitions": len(actions),
        "num_trajectories": int(dataset_meta.total_episodes),
    }


def read_actions(file: Path) -> np.ndarray:
    """The actions of one of a dataset's files, in rows. → (N, A)"""
    column = pq.read_table(file, columns=[ACTION]).column(ACTION)
    numbers = [chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks]
    return np.concatenate(numbers).reshape(len(column), -1).astype(np.float64)


def action_statistics(actions: np.ndarray, names: Sequence[str]) -> dict[str, list[Any]]:
    """Of N actions (N, A). A gripper within [-1, 1] is masked out, so that it stays as it is."""
    bounded = np.abs(actions).max(axis=0) <= 1
    numbers = {
        "mean": actions.mean(axis=0), "std": actions.std(axis=0), "min": actions.min(axis=0),
        "max": actions.max(axis=0), "q01": np.quantile(actions, 0.01, axis=0),
        "q99": np.quantile(actions, 0.99, axis=0),
    }  # fmt: skip
    mask = [not (GRIPPER in name and inside) for name, inside in zip(names, bounded, strict=True)]
    return {**{name: value.tolist() for name, value in numbers.items()}, "mask": mask}


def component_names(names: Any, count: int) -> list[str]:
    """Those of a dataset's feature, which may be a list, a dict of lists, or nothing. → `count` names"""
    if isinstance(names, Mapping):
        names = [name for part in names.values() for name in (part if isinstance(part, list) else [part])]
    known = [str(name).lower() for name in names or ()]
    return known if len(known) == count else [""] * count


def used_statistics(norm_stats: NormStats) -> NormStats:
    """Only what a policy needs: quantiles and mask of each dataset's actions."""
    return {
        key: {"action": {name: values for name, values in entry["action"].items() if name in USED}}
        for key, entry in norm_stats.items()
    }


def choose_key(norm_stats: Iterable[str], unnorm_key: str | None) -> str | None:
    """The dataset whose statistics apply: the only one needs no naming. ValueError lists the known ones."""
    known = sorted(norm_stats)
    if unnorm_key is None:
        return known[0] if len(known) == 1 else None
    if unnorm_key not in known:
        raise ValueError(f"unnorm_key={unnorm_key}: no such statistics; choose one of {', '.join(known)}")
    return unnorm_key


def lerobot_statistics(action: Mapping[str, Sequence[Any]]) -> dict[str, np.ndarray]:
    """One dataset's `action` entry as LeRobot's quantile normalisation takes it: q01, q99 (A,).

    A component outside the mask gets −1 and 1, which changes nothing.
    """
    low, high = (np.array(action[name], dtype=np.float64) for name in QUANTILES)
    mask = np.array(action.get("mask", [True] * len(low)))
    return {"q01": np.where(mask, low, -1.0), "q99": np.where(mask, high, 1.0)}
