"""Actions: as tokens of the language model, and the statistics that map them to the robot's.

An action is 256 bins over [-1, 1] per component, written with the last 256 ids of the tokenizer's vocabulary.
OpenVLA maps the 1st and 99th percentile of each component to −1 and 1. Components outside its `mask`, such as
the gripper, stay as they are. A is the number of components, N of actions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.embodiment import component_names
from lerobot_wmrl.data.episodes import parquet_files, read_vectors

BINS: Final = 256
EDGES: Final = np.linspace(-1, 1, BINS)
"""Edges of the bins, from NumPy in float64: torch's differ in the last bit, which moves an action on an
edge."""


@dataclass(frozen=True)
class ActionTokenizer:
    """Maps actions to token ids and back.

    Args:
        vocabulary: number of the tokenizer's ids: 32000 in the release, with the action tokens 31744 … 31999.
    """

    vocabulary: int

    @property
    def first_id(self) -> int:
        """The lowest of the 256 ids, which stands for the largest actions."""
        return self.vocabulary - BINS

    def encode(self, actions: Tensor) -> Tensor:
        """Return the ids of normalised actions, clipped to [-1, 1]: −1 is the last id, 1 the first."""
        edges = torch.from_numpy(EDGES).to(actions.device)
        return self.vocabulary - torch.bucketize(actions.double().clamp(-1, 1), edges, right=True)

    def decode(self, ids: Tensor) -> Tensor:
        """Return the centres of the bins, float32. The first two ids share one; other ids are clipped."""
        centres = torch.from_numpy((EDGES[:-1] + EDGES[1:]) / 2).to(ids.device)
        return centres[(self.vocabulary - 1 - ids).clamp(0, BINS - 2)].float()

    def columns(self, ids: Tensor) -> Tensor:
        """Return the ids' columns 0 … 255 among the action tokens. Raises ValueError for any other id."""
        columns = ids - self.first_id
        outside = (columns < 0) | (columns >= BINS)
        if bool(outside.any()):
            raise ValueError(
                f"token id {ids[outside][0].item()} is no action token: labels are from {self.first_id} to "
                f"{self.vocabulary - 1}"
            )
        return columns


NormStats = dict[str, Any]
"""OpenVLA's: dataset → {"action": {"q01", "q99", "mask", …}, …}, lists of one number a component."""

GRIPPER = "gripper"
QUANTILES = ("q01", "q99")
USED = (*QUANTILES, "mask")


def adopt_statistics(config: Any, dataset_meta: Any) -> None:
    """Store a dataset's statistics in the configuration of a policy that will learn from it, and apply them.

    LeRobot gives the statistics in `dataset_meta` to the processors after it has built the policy, also to
    those of a checkpoint. So they are replaced there as well.

    Args:
        config: the policy's `OpenVLAConfig`; its `norm_stats` and `unnorm_key` change.
        dataset_meta: metadata of a LeRobotDataset; its statistics of the action change.
    """
    quantiles = {name: np.asarray(value).tolist() for name, value in dataset_meta.stats[ACTION].items()}
    entry = dataset_statistics(dataset_meta) or {"action": quantiles}
    config.norm_stats = {**config.norm_stats, dataset_meta.repo_id: entry}
    config.unnorm_key = dataset_meta.repo_id
    dataset_meta.stats[ACTION] = {**dataset_meta.stats[ACTION], **lerobot_statistics(entry["action"])}


def dataset_statistics(dataset_meta: Any) -> NormStats | None:
    """Return the statistics that OpenVLA's training derives from a dataset's actions; None if not on disk.

    LeRobot's own quantiles are means over the episodes' quantiles, which differ.
    """
    root = Path(dataset_meta.root)
    if not parquet_files(root):
        return None
    actions = read_vectors(root, ACTION)
    return {
        "action": action_statistics(actions, component_names(dataset_meta.features[ACTION])),
        "num_transitions": len(actions),
        "num_trajectories": int(dataset_meta.total_episodes),
    }


def action_statistics(actions: np.ndarray, names: Sequence[str]) -> dict[str, list[Any]]:
    """Compute the statistics of actions (N, A). A gripper within [-1, 1] is masked out: it stays as it is."""
    bounded = np.abs(actions).max(axis=0) <= 1
    statistics = {
        "mean": actions.mean(axis=0),
        "std": actions.std(axis=0),
        "min": actions.min(axis=0),
        "max": actions.max(axis=0),
        "q01": np.quantile(actions, 0.01, axis=0),
        "q99": np.quantile(actions, 0.99, axis=0),
    }
    mask = [not (GRIPPER in name.lower() and inside) for name, inside in zip(names, bounded, strict=True)]
    return {**{name: value.tolist() for name, value in statistics.items()}, "mask": mask}


def used_statistics(norm_stats: NormStats) -> NormStats:
    """Return only what a policy needs: quantiles and mask of each dataset's actions."""
    return {
        key: {"action": {name: values for name, values in entry["action"].items() if name in USED}}
        for key, entry in norm_stats.items()
    }


def choose_key(norm_stats: Iterable[str], unnorm_key: str | None) -> str | None:
    """Return the dataset whose statistics apply; the only one needs no naming.

    Raises:
        FieldError: if there are none under that name.
    """
    known = sorted(norm_stats)
    if unnorm_key is None:
        return known[0] if len(known) == 1 else None
    if unnorm_key not in known:
        problem = f"no such statistics; choose one of {', '.join(known)}"
        raise FieldError("unnorm_key", unnorm_key, problem)
    return unnorm_key


def lerobot_statistics(action: Mapping[str, Sequence[Any]]) -> dict[str, np.ndarray]:
    """Return a dataset's `action` entry in the form of LeRobot's quantile normalisation: q01, q99 (A,).

    A component outside the mask gets −1 and 1, which leaves it as it is.
    """
    low, high = (np.array(action[name], dtype=np.float64) for name in QUANTILES)
    mask = np.array(action.get("mask", [True] * len(low)))
    return {"q01": np.where(mask, low, -1.0), "q99": np.where(mask, high, 1.0)}
