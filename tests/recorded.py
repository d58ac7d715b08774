"""A recording as small as it can be, whose kinds and outcomes are known."""

from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import KINDS, START_COLUMNS

ROWS = 3


def write_recording(root: Path) -> None:
    """Write four episodes of three rows; the first and the last succeed, at their last row."""
    features = {
        "action": {"dtype": "float32", "shape": (2,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        **{name: {"dtype": "int64", "shape": (1,), "names": None} for name in START_COLUMNS},
    }
    dataset = LeRobotDataset.create("local/recording", 25, features, root=root, use_videos=False)
    for seed, kind in enumerate(("optimal", "optimal", "near_miss", "optimal")):
        values = (0, seed // 2, seed, KINDS.index(kind))
        start = {name: np.array([value]) for name, value in zip(START_COLUMNS, values, strict=True)}
        for row in range(ROWS):
            success, action = np.array([seed in (0, 3) and row == ROWS - 1]), np.zeros(2, np.float32)
            dataset.add_frame({"action": action, "next.success": success, **start, "task": "push"})
        dataset.save_episode()
    dataset.finalize()
