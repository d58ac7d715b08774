"""What the episodes of a recording are, read from its parquet columns: no video is decoded."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq


def parquet_files(root: Path) -> list[Path]:
    """The files that hold a dataset's rows, in order."""
    return sorted((root / "data").rglob("*.parquet"))


def recorded_episodes(root: Path) -> dict[str, np.ndarray]:
    """Columns (E,) one row an episode: episode, kind, seed, scene, length in rows, success at any row."""
    columns = ["episode_index", "start.kind", "start.seed", "start.scene", "next.success"]
    rows = [pq.read_table(path, columns=columns).to_pydict() for path in parquet_files(root)]
    stacked = {
        name: np.concatenate([np.asarray(part[name]).reshape(-1) for part in rows]) for name in columns
    }
    episodes, first, inverse = np.unique(stacked["episode_index"], return_index=True, return_inverse=True)
    success = np.zeros(len(episodes), dtype=bool)
    np.logical_or.at(success, inverse, stacked["next.success"].astype(bool))
    return {
        "episode": episodes,
        "kind": stacked["start.kind"][first],
        "seed": stacked["start.seed"][first],
        "scene": stacked["start.scene"][first],
        "length": np.bincount(inverse),
        "success": success,
    }
