"""Print which policy of a comparison to go on with: the first, unless another is decided to be better.

python -m experiments.choose_policy outputs/comparison
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_wmrl.scripts.compare import RESULTS


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("comparison", type=Path, help="output folder of lerobot-wmrl-compare")
    return parser


def chosen_policy(results: Mapping[str, Any]) -> str:
    """Return the most successful of those that succeed more often than the first, or the first.

    Raises:
        ValueError: the comparison was interrupted.
    """
    if not results["finished"]:
        raise ValueError("the comparison is not finished: run its command again")
    first, *_ = policies = results["policies"]
    against = [pair for pair in results["pairs"] if pair["before"] == first]
    better = [pair["after"] for pair in against if pair["better"] == pair["after"]]
    return str(max(better, key=lambda name: policies[name]["share"], default=first))


def main() -> None:
    """Entry point."""
    folder: Path = make_parser().parse_args().comparison
    try:
        print(chosen_policy(json.loads((folder / RESULTS).read_text())))
    except (OSError, ValueError) as error:
        sys.exit(f"error: {folder}: {error}")


if __name__ == "__main__":
    main()
