"""Labels by hand, `--success.type=by_hand` of lerobot-wmrl-label: its settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_wmrl.common.errors import Stopped, require_at_least
from lerobot_wmrl.play.checks import LAST_PORT, whole_number
from lerobot_wmrl.rewards.success_rules import SuccessRule, next_frame_solved

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


@SuccessRule.register_subclass("by_hand")
@dataclass
class ByHandRule(SuccessRule):
    """What somebody says on a page that shows the episodes: key S for success, F for failure.

    Args:
        file: where the labels are kept while they are made. The same command goes on with them.
        last: how many of the last frames of an episode count if it succeeds; on the page any other frame can
            be chosen.
        host: address at which the page is served.
        port: port at which the page is served; 0 for any that is free.
    """

    file: Path = Path("outputs/labels.json")
    last: int = 3
    host: str = "127.0.0.1"
    port: int = 8000

    def __post_init__(self) -> None:
        require_at_least(self, 1, "last")
        whole_number("port", self.port, LAST_PORT)

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        from lerobot_wmrl.play.label_page import LabelPage, solved_frames
        from lerobot_wmrl.play.web import serve

        page = LabelPage(self.file, self.last, self.host, dataset)
        try:
            serve(page.application(), page.access, self.port, "its button goes on", page.finished)
        except KeyboardInterrupt as interrupt:
            raise Stopped(
                f"{len(page.labels)} of {len(page.lengths)} episodes have a label, kept in {self.file}; "
                "the same command goes on"
            ) from interrupt
        return next_frame_solved(solved_frames(page.labels, dataset), dataset)
