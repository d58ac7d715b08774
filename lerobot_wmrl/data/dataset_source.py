"""Where a command's data is."""

from dataclasses import dataclass, field


@dataclass
class DatasetSource:
    """A LeRobotDataset on disk: `root`, its folder, and optionally the `repo_id` it was published as."""

    root: str = ""
    repo_id: str | None = None


@dataclass
class TrainingData(DatasetSource):
    """A dataset to learn from.

    Args:
        episodes: indices of those to learn from, as in lerobot-train; by default all. Those that are held
            out stay held out.
        more: roots of further datasets to learn from: every second step's batch is of one of them, in turn
            (half old, half new: Ball et al. 2023).
    """

    episodes: list[int] | None = None
    more: list[str] = field(default_factory=list)
