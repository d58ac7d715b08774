"""Print which episodes of a recording a policy is cloned from, as `--dataset.episodes=[…]` has them.

python -m experiments.steps.choose_episodes outputs/planned --optimal=320
python -m experiments.steps.choose_episodes outputs/attempts --successes=160
python -m experiments.steps.choose_episodes outputs/attempts --every_success
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from lerobot_wmrl.common.constants import KINDS, START_KIND, START_SCENE
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import SUCCESS, read_episodes


def count(value: str) -> int:
    """Read a number of episodes. ArgumentTypeError if it is not a whole number from 1 on."""
    if not value.isdecimal() or not int(value):
        raise argparse.ArgumentTypeError(f"{value!r} is not a whole number from 1 on")
    return int(value)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="a recorded LeRobotDataset")
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument("--optimal", type=count, help="as many optimal successes, from the scenes in turn")
    chosen.add_argument("--successes", type=count, help="the first successes")
    chosen.add_argument("--every_success", action="store_true", help="all successes")
    return parser


def optimal_episodes(root: Path, count: int) -> list[int]:
    """Return the first `count` successful episodes of the kind `optimal`, taken from the scenes in turn.

    Raises:
        ValueError: there are not so many.
    """
    table = read_episodes(open_dataset(root))
    scenes = table.columns[START_SCENE]
    chosen = (table.columns[START_KIND] == KINDS.index("optimal")) & table.success
    rank = np.zeros(len(chosen), dtype=np.int64)
    for scene in np.unique(scenes):
        members = chosen & (scenes == scene)
        rank[members] = np.arange(members.sum())
    order = sorted(np.flatnonzero(chosen), key=lambda row: (rank[row], scenes[row]))
    if len(order) < count:
        raise ValueError(
            f"{root} holds {len(order)} successful optimal episodes, {count} are needed: record more"
        )
    return sorted(map(int, order[:count]))


def successes(root: Path, count: int | None) -> list[int]:
    """Return the first `count` successful episodes, or all. ValueError if there are not so many, or none."""
    table = read_episodes(open_dataset(root))
    if SUCCESS not in table.dataset.features:
        raise FieldError(
            "dataset.root", root, f"has no column {SUCCESS}", "record it with lerobot-wmrl-record"
        )
    successful = np.flatnonzero(table.success)
    if len(successful) < (count or 1):
        raise ValueError(f"{root}: {len(successful)} successes, {count or 1} are needed: record more")
    return [int(episode) for episode in successful[:count]]


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    try:
        if given.optimal is not None:
            chosen = optimal_episodes(given.root, given.optimal)
        else:
            chosen = successes(given.root, given.successes)
    except ValueError as error:
        sys.exit(f"error: {error}")
    print(",".join(map(str, chosen)))


if __name__ == "__main__":
    main()
