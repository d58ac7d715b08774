"""Print which policy of a comparison to go on with: the first, unless another is decided to be better.

python -m experiments.steps.choose_policy outputs/comparison
"""

import argparse
import json
import sys
from pathlib import Path

from lerobot_wmrl.evaluation.comparison import COMPARISON_FILE, chosen_policy


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("comparison", type=Path, help="output folder of lerobot-wmrl-compare")
    return parser


def main() -> None:
    """Entry point."""
    folder: Path = make_parser().parse_args().comparison
    try:
        print(chosen_policy(json.loads((folder / COMPARISON_FILE).read_text())))
    except (OSError, ValueError) as error:
        sys.exit(f"error: {folder}: {error}")


if __name__ == "__main__":
    main()
