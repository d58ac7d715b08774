"""Console commands in the test's own process, which has imported what another would import for seconds."""

import sys
from unittest.mock import patch

from lerobot_wmrl.common.forks import entry_point


def run_here(program: str, *flags: str) -> None:
    """Run a console command, as its entry point does. SystemExit if it fails."""
    with patch.object(sys, "argv", [program, *flags]):
        status = entry_point(program)()
    if status:
        raise SystemExit(status)
