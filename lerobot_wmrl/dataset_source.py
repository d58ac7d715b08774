"""Where a command's data is."""

from dataclasses import dataclass


@dataclass
class DatasetSource:
    """A LeRobotDataset on disk: `root`, its folder, and optionally the `repo_id` it was published as."""

    root: str = ""
    repo_id: str | None = None
