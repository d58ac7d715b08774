"""Numbers of a run as JSON lines, which anything can plot."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

METRICS_FILE = "metrics.jsonl"


def append_metrics(output_dir: Path, step: int, metrics: Mapping[str, float]) -> None:
    """Add one line `{"step": step, name: value, …}` to the run's metrics file."""
    with (output_dir / METRICS_FILE).open("a") as file:
        file.write(json.dumps({"step": step, **metrics}) + "\n")


def read_metrics(output_dir: Path) -> list[dict[str, Any]]:
    """The lines in order of steps; after a resume the later line of a step wins, torn lines are dropped."""
    path = output_dir / METRICS_FILE
    lines: dict[int, dict[str, Any]] = {}
    for text in path.read_text().splitlines() if path.is_file() else []:
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        lines[line["step"]] = line
    return [lines[step] for step in sorted(lines)]
