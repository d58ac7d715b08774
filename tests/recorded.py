"""A recording as small as it can be, whose kinds and outcomes are known."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_wmrl.common.constants import KINDS


def write_recording(root: Path) -> None:
    """Write four episodes of three rows; the first and the last succeed, at their last row."""
    kinds = [KINDS.index(kind) for kind in ("optimal", "optimal", "near_miss", "optimal")]
    starts = {
        "start.task": [0, 0, 0, 0],
        "start.kind": kinds,
        "start.seed": range(4),
        "start.scene": [0, 0, 1, 1],
        "episode_index": range(4),
    }
    success = np.zeros((4, 3), dtype=bool)
    success[[0, 3], -1] = True
    table = {name: np.repeat(values, 3) for name, values in starts.items()}
    table["next.success"] = success.reshape(-1)
    (root / "data" / "chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(table), root / "data" / "chunk-000" / "file-000.parquet")
