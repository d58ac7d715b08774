"""Results of an improvement, read from what its commands wrote into its folder."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.comparison import COMPARISON_FILE, Comparison, episodes_from_json
from lerobot_wmrl.improve.stage_names import StageName
from lerobot_wmrl.rl.callbacks import RECORD_FILE, Record
from lerobot_wmrl.rl.gate_callback import SuccessGate
from lerobot_wmrl.rl.selection import Selection

CHECK: Final = f"{StageName.CHECK}/metrics.json"
"""What the world model says of recorded episodes."""


@dataclass(frozen=True)
class Place:
    """Policies compared in one place.

    Args:
        name: the place, as a phrase: `in pusht`.
        comparison: comparison of the policies, by what they are.
    """

    name: str
    comparison: Comparison

    @property
    def rates(self) -> dict[str, Proportion]:
        """Success of each policy."""
        return self.comparison.rates()


def read_place(name: str, folder: Path, titles: Sequence[str]) -> Place:
    """Read a finished comparison of policies, which have these titles, in this order."""
    saved = read_json(folder / COMPARISON_FILE)
    episodes = episodes_from_json(saved)
    starts = len({episode.seed for episode in episodes})
    return Place(name, Comparison(titles, starts, "all", saved["alpha"], stop_early=False, episodes=episodes))


def read_check(out: Path) -> dict[str, Any]:
    """Read what the world model says of recorded episodes."""
    return read_json(out / CHECK)


def read_gate(out: Path) -> dict[str, Any] | None:
    """Read what the gate found before RL; None if there was none."""
    records = sorted((out / StageName.RL / SuccessGate.name).glob(f"*/{RECORD_FILE}"))
    return read_json(records[-1]) if records else None


def read_selection(out: Path) -> dict[int, Record]:
    """Read how successful RL's checkpoints were in the real environment, by iteration; nothing without
    selection."""
    folders = (out / StageName.RL / Selection.name).glob(f"*/{RECORD_FILE}")
    return {int(path.parent.name): read_json(path) for path in folders}


def read_json(path: Path) -> dict[str, Any]:
    """Read what a stage wrote."""
    content: dict[str, Any] = json.loads(path.read_text())
    return content
