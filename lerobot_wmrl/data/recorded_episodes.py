"""What the episodes of a recording are, read from its parquet columns: no video is decoded."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from lerobot_wmrl.common.constants import START_COLUMNS


def parquet_files(root: Path) -> list[Path]:
    """The files that hold a dataset's rows, in order."""
    return sorted((root / "data").rglob("*.parquet"))


def recorded_episodes(root: Path) -> dict[str, np.ndarray]:
    """Columns (E,) one row an episode: episode, task, kind, seed, scene, length in rows, success in any."""
    columns = ["episode_index", *START_COLUMNS, "next.success"]
    rows = [pq.read_table(path, columns=columns).to_pydict() for path in parquet_files(root)]
    stacked = {
        name: np.concatenate([np.asarray(part[name]).reshape(-1) for part in rows]) for name in columns
    }
    episodes, first, inverse = np.unique(stacked["episode_index"], return_index=True, return_inverse=True)
    success = np.zeros(len(episodes), dtype=bool)
    np.logical_or.at(success, inverse, stacked["next.success"].astype(bool))
    return {
        "episode": episodes,
        "task": stacked["start.task"][first],
        "kind": stacked["start.kind"][first],
        "seed": stacked["start.seed"][first],
        "scene": stacked["start.scene"][first],
        "length": np.bincount(inverse),
        "success": success,
    }
