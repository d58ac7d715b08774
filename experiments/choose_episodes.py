"""Print which episodes of a recording a policy is cloned from, as `--dataset.episodes=[…]` has them.

python -m experiments.choose_episodes outputs/planned --optimal=320
python -m experiments.choose_episodes outputs/attempts --successes=160
python -m experiments.choose_episodes outputs/attempts --every_success
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
    chosen.add_argument("--every_success", action="store_true", help="all successes")
    return parser


def successes(root: Path, count: int | None) -> list[int]:
    """Return the first `count` successful episodes, or all. ValueError if there are not so many, or none."""
    table = recorded_episodes(root)
    found = table["episode"][table["success"]]
    if len(found) < (count or 1):
        raise ValueError(f"{root}: {len(found)} successes, {count or 1} are needed: record more")
    return [int(episode) for episode in found[:count]]


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    if given.optimal:
        chosen = optimal_episodes(given.root, given.optimal)
    else:
        chosen = successes(given.root, given.successes)
    print(",".join(map(str, chosen)))


if __name__ == "__main__":
    main()
