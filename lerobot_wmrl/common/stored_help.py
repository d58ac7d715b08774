"""Pages of `--help`, stored: LeRobot and torch take seconds to import, which nobody who asks for help needs.

`make help` writes the pages, and a test compares them with what the commands would say.
"""

import sys
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "help"


def answer_help() -> None:
    """Print the stored page and exit, if this process is one of the console commands with `--help` alone.

    With more flags (`--env.type=wmrl_maniskill --help`) the command answers itself, for those flags' types.
    """
    page = FOLDER / f"{Path(sys.argv[0]).name}.txt"
    if sys.argv[1:] in (["--help"], ["-h"]) and page.is_file():
        print(page.read_text(), end="")
        sys.exit()
