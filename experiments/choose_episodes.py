"""Print which episodes of a recording a policy is cloned from, as `--dataset.episodes=[…]` has them.

python -m experiments.choose_episodes outputs/planned --optimal=320
python -m experiments.choose_episodes outputs/attempts --successes=160
"""

import argparse
from pathlib import Path

from lerobot_wmrl.demo.stages import optimal_episodes
from lerobot_wmrl.maniskill.recordings import recorded_episodes


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="a recorded LeRobotDataset")
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument("--optimal", type=int, help="as many optimal successes, from the scenes in turn")
    chosen.add_argument("--successes", type=int, help="the first successes")
    return parser


def successes(root: Path, count: int) -> list[int]:
    """Return the first `count` successful episodes. ValueError if there are not so many."""
    table = recorded_episodes(root)
    found = table["episode"][table["success"]]
    if len(found) < count:
        raise ValueError(f"{root}: {len(found)} successes, {count} are needed: record more")
    return [int(episode) for episode in found[:count]]


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    choose, count = (optimal_episodes, given.optimal) if given.optimal else (successes, given.successes)
    print(",".join(map(str, choose(given.root, count))))


if __name__ == "__main__":
    main()
