"""Where a command's data is."""

from dataclasses import dataclass


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
    """

    episodes: list[int] | None = None
