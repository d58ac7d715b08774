"""Copy a dataset with the labels or the actions of its episodes shuffled: a control.

    python -m experiments.steps.shuffled outputs/dataset outputs/shuffled --what=labels
    python -m experiments.steps.shuffled outputs/dataset outputs/shuffled --what=actions

Every episode keeps its pictures and takes the labels (or the actions) of another, chosen at random, from its
beginning on. Where the other episode is shorter, its last label or action is repeated.

Labels are not aligned at the ends: recordings stop at success, so that the last frames would often keep the
right label.
"""

import argparse
import shutil
import sys
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, REWARD

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import whole_folder
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, parquet_files, read_episodes

COLUMNS: Final = {"labels": ("next.success", DONE, REWARD), "actions": (ACTION,)}


def donor_rows(table: EpisodeTable, seed: int) -> np.ndarray:
    """Return for each row the row of another episode whose labels or actions it takes. (N,)"""
    order = np.random.default_rng(seed).permutation(len(table.start))
    rows = np.empty(int(table.length.sum()), int)
    for episode, other in zip(order, np.roll(order, 1), strict=True):
        start, length = table.start[episode], table.length[episode]
        rows[start : start + length] = table.start[other] + np.arange(length).clip(
            max=table.length[other] - 1
        )
    return rows


def shuffle(root: Path, folder: Path, what: str, seed: int) -> LeRobotDataset:
    """Copy the dataset at `root` to `folder`, shuffled. FieldError if `folder` exists."""
    if folder.exists():
        raise FieldError("folder", folder, "exists", "remove it or choose another")
    rows = donor_rows(read_episodes(open_dataset(root)), seed)
    with whole_folder(folder) as partial:
        shutil.copytree(root, partial)
        files = parquet_files(partial)
        whole = pq.ParquetDataset(files).read(columns=["index", *COLUMNS[what]]).sort_by("index")
        for path in files:
            table = pq.read_table(path)
            taken = whole.take(rows[table["index"].to_numpy()])
            for name in COLUMNS[what]:
                column = table.schema.get_field_index(name)
                table = table.set_column(column, table.schema.field(column), taken[name])
            pq.write_table(table, path)
    return open_dataset(folder)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="a LeRobotDataset of lerobot-wmrl-record")
    parser.add_argument("folder", type=Path, help="where the copy goes")
    parser.add_argument("--what", choices=COLUMNS, required=True, help="what is shuffled")
    parser.add_argument("--seed", type=int, default=0, help="of the shuffle")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    try:
        shuffle(given.root, given.folder, given.what, given.seed)
    except ValueError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
