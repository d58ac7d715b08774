"""From many sub-datasets to one, with LeRobot's own tool."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.aggregate import aggregate_datasets

from lerobot_dataset_maniskill.card import write_card
from lerobot_dataset_maniskill.writer import write_vocabulary
from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.maniskill.recordings import recorded_episodes


def merge_folders(folders: Sequence[Path], target: Path, repo_id: str) -> None:
    """All episodes of `folders`, in order, as a dataset at `target`, which must not exist."""
    aggregate_datasets(
        repo_ids=[repo_id] * len(folders), aggr_repo_id=repo_id, roots=list(folders), aggr_root=target,
        concatenate_videos=False, concatenate_data=False,  # appending rewrites the whole file for every part
    )  # fmt: skip


def finish(merged: Path, output_dir: Path, repo_id: str, content: Mapping[str, Any]) -> None:
    """Add vocabulary, pictures and card, move the whole into place at once, and say what it holds."""
    write_vocabulary(merged, content)
    table = recorded_episodes(merged)
    write_card(merged, repo_id, table)
    merged.replace(output_dir)
    rates = success_by_kind(table)
    summary = ", ".join(f"{kind} {wins}/{total}" for kind, (wins, total) in rates.items())
    print(f"{output_dir}: {len(table['episode'])} episodes; successful: {summary}")


def success_by_kind(table: Mapping[str, np.ndarray]) -> dict[str, tuple[int, int]]:
    """Kind → (successful episodes, episodes), of `lerobot_wmrl.maniskill.recordings.recorded_episodes`."""
    kinds, success = table["kind"], table["success"]
    return {
        name: (int(success[kinds == index].sum()), int(np.sum(kinds == index)))
        for index, name in enumerate(KINDS)
        if np.any(kinds == index)
    }
