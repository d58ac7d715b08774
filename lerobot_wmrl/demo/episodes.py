"""Which recorded episodes a policy is cloned from."""

from pathlib import Path

import numpy as np

from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.data.recorded_episodes import recorded_episodes


def optimal_episodes(root: Path, count: int) -> list[int]:
    """The first `count` successful episodes of the kind `optimal`, taken from the scenes in turn."""
    table = recorded_episodes(root)
    chosen = (table["kind"] == KINDS.index("optimal")) & table["success"]
    rank = np.zeros(len(chosen), dtype=np.int64)
    for scene in np.unique(table["scene"]):
        members = chosen & (table["scene"] == scene)
        rank[members] = np.arange(members.sum())
    order = sorted(np.flatnonzero(chosen), key=lambda row: (rank[row], table["scene"][row]))
    if len(order) < count:
        raise ValueError(
            f"{root} holds {len(order)} successful optimal episodes, {count} are needed: record more"
        )
    return sorted(int(table["episode"][row]) for row in order[:count])
