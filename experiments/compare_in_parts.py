"""Run lerobot-wmrl-compare in several processes, each on starts of its own, and join what they find.

    python -m experiments.compare_in_parts --parts=5 --n_episodes=20 --seed=1000000 \\
        --policies=[outputs/cloned,outputs/improved] --env.type=metaworld --env.task=push-v3 \\
        --output_dir=outputs/comparison

`--n_episodes` are those of one process. For environments that take one start at a time. All further flags are
those of lerobot-wmrl-compare.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.processes import find_program
from lerobot_wmrl.scripts.compare import RESULTS


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", type=int, required=True, help="processes")
    parser.add_argument("--n_episodes", type=int, required=True, help="starts of each process")
    parser.add_argument("--seed", type=int, required=True, help="of the first start")
    parser.add_argument(
        "--output_dir", type=Path, required=True, help="a folder for each process, and both results"
    )
    return parser


def run_parts(given: argparse.Namespace, flags: Sequence[str]) -> list[Path]:
    """Run all processes at once and return their results. Exits if one of them fails."""
    processes = {}
    for part in range(given.parts):
        folder = given.output_dir / str(part)
        folder.mkdir(parents=True, exist_ok=True)
        own = [
            f"--n_episodes={given.n_episodes}", f"--seed={given.seed + part * given.n_episodes}",
            "--stop_early=false", f"--output_dir={folder}",
        ]  # fmt: skip
        with (given.output_dir / f"{part}.log").open("ab") as log:
            processes[folder] = subprocess.Popen(
                [find_program("lerobot-wmrl-compare"), *flags, *own], stdout=log, stderr=log
            )
    try:
        failed = [str(folder) for folder, process in processes.items() if process.wait()]
    finally:
        for process in processes.values():
            process.terminate()
    if failed:
        sys.exit(f"error: failed, see the logs beside them: {', '.join(failed)}")
    return [folder / RESULTS for folder in processes]


def joined(parts: Sequence[Path]) -> dict[str, list[bool]]:
    """Return each policy's success from every start, in the order of the starts."""
    found: dict[str, list[bool]] = {}
    for part in parts:
        comparison: dict[str, Any] = json.loads(part.read_text())
        for column, policy in enumerate(comparison["policies"]):
            outcomes = [each["successes"][column] for each in comparison["episodes"]]
            found.setdefault(policy, []).extend(outcomes)
    return found


def main() -> None:
    """Entry point."""
    given, flags = make_parser().parse_known_args()
    write_json(given.output_dir / "outcomes.json", joined(run_parts(given, flags)))


if __name__ == "__main__":
    main()
