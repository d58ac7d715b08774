"""Demonstrations of PushT by the example's scripted pusher."""

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[1] / "examples" / "record_pusht.py"


def record_pusht(root: Path, *flags: str) -> Path:
    """Run the example, which records a dataset at `root`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [EXAMPLE.name, f"--root={root}", *flags])
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    return root
