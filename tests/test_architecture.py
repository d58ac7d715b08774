"""The arrows of the design hold, and the layout that packaging relies on is kept."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOMS = "lerobot_wmrl", "policies", "robots", "datasets", "experiments", "benchmarks", "tools"


def test_imports_follow_the_contracts() -> None:
    command = [Path(sys.executable).with_name("lint-imports"), "--config", ROOT / "pyproject.toml"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_folders_named_like_packages_stay_folders() -> None:
    """`datasets` is Hugging Face's package: an `__init__.py` of ours would hide it from commands run here."""
    for folder in ("datasets", "policies"):
        assert not (ROOT / folder / "__init__.py").exists()
        assert {path.name.split("_")[0] for path in (ROOT / folder).iterdir()} <= {"lerobot", "recipes"}
    assert not list(ROOT.rglob("lerobot_*/**/utils.py"))


def test_files_and_functions_are_short_enough_to_be_read_at_once() -> None:
    """As CONTRIBUTING.md says."""
    long = []
    for path in (path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        text = path.read_text()
        functions = [each for each in ast.walk(ast.parse(text)) if isinstance(each, ast.FunctionDef)]
        long += [path] if text.count("\n") > 400 else []
        long += [each.name for each in functions if (each.end_lineno or 0) - each.lineno >= 50]
    assert long == []
