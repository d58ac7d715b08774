"""What counts as success in a dataset that does not say so. N frames, E episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from draccus import ChoiceRegistry

from lerobot_wmrl.common.constants import DONE_FRAMES
from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.data.episodes import require_episodes

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


@dataclass
class SuccessRule(ChoiceRegistry):
    """What counts as success."""

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        """Return `next.success`: whether the task is solved in the frame after each row's action. (N,) bool

        Raises:
            FieldError: the rule does not fit the dataset.
        """
        raise NotImplementedError


@SuccessRule.register_subclass("ends")
@dataclass
class EndsRule(SuccessRule):
    """The last frames of episodes that are known to succeed, such as demonstrations.

    Args:
        episodes: the episodes that succeed, by their indices; by default all. The others fail: all of them
            with `[]`.
        last: how many of their last frames count. World models ask for `done_frames` (3) in a row. Frames in
            which the task is not solved yet would teach a wrong success.
    """

    episodes: list[int] | None = None
    last: int = 3

    def __post_init__(self) -> None:
        require_at_least(self, 1, "last")

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        episode, frame, length = frame_positions(dataset)
        solved = frame >= length - self.last
        if self.episodes is not None:
            require_episodes("episodes", self.episodes, dataset.meta.total_episodes, dataset.root)
            solved &= np.isin(episode, self.episodes)
        return next_frame_solved(solved, dataset)


@SuccessRule.register_subclass("first_frames")
@dataclass
class FirstFramesRule(SuccessRule):
    """All frames from a given one on, in the episodes that succeed.

    Args:
        first: episode → the first frame in which the task is solved, both from 0 on: `{0: 120, 3: 95}`.
            Episodes that are not named fail: all of them with `{}`.
    """

    first: dict[str, float | None] | None = None  # so that draccus leaves it to `whole_numbers` what is none

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        episode, *_ = frame_positions(dataset)
        if self.first is None:
            raise FieldError(
                "first", None, "names no episode that succeeds", "name those that do, or {} if none does"
            )
        numbers = whole_numbers("first", self.first)
        require_episodes("first", numbers, dataset.meta.total_episodes, dataset.root)
        solved = np.zeros(len(episode), bool)
        for index, first in numbers.items():
            begin, end = np.searchsorted(episode, (index, index + 1))
            if not 0 <= first < end - begin:
                raise FieldError(
                    "first",
                    self.first,
                    f"episode {index} has no frame {first}",
                    f"its frames are 0 to {end - begin - 1}",
                )
            solved[begin + first : end] = True
        return next_frame_solved(solved, dataset)


@SuccessRule.register_subclass("column")
@dataclass
class ColumnRule(SuccessRule):
    """Rows in which a column of the dataset reaches a threshold, such as `next.reward` or another label.

    The column says of each row what its action leads to, as LeRobot's columns `next.…` do.

    Args:
        column: its name.
        threshold: the value from which a row counts.
    """

    column: str = "next.reward"
    threshold: float = 0.5

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        feature = dataset.features.get(self.column)
        if feature is None or tuple(feature["shape"]) != (1,) or feature["dtype"] == "string":
            single = [name for name, each in dataset.features.items() if tuple(each["shape"]) == (1,)]
            raise FieldError(
                "column",
                self.column,
                f"is no column of one number in {dataset.root}",
                f"choose one of {', '.join(single)}",
            )
        rows = dataset.hf_dataset.with_format("numpy", columns=[self.column])[:]
        return reach(np.asarray(rows[self.column], np.float64).reshape(-1), self.threshold)


@SuccessRule.register_subclass("reward_model")
@dataclass
class RewardModelRule(SuccessRule):
    """Rows in which a reward model reaches a threshold: LeRobot's classifier, or one of this package. Both
    have learnt to predict `next.reward` of the row that they are shown.

    LeRobot's other reward models look at whole episodes, one instruction at a time. Let them write a column,
    and use the type `column`.

    Args:
        path: its checkpoint, a folder or a hub id.
        threshold: the reward from which a row counts. A classifier gives 0 or 1.
        device: where it runs; by default where the checkpoint says.
    """

    path: str = ""
    threshold: float = 0.5
    device: str | None = None

    def labels(self, dataset: "LeRobotDataset") -> np.ndarray:
        from lerobot_wmrl.rewards.frame_rewards import frame_rewards

        return reach(frame_rewards(self.path, self.device, dataset), self.threshold)


def whole_numbers(name: str, pairs: Mapping[str, float | None]) -> dict[int, int]:
    """Return episodes and frames as whole numbers. FieldError names a pair that is not of two."""
    if None in pairs.values():  # YAML reads `0:45` as a text or one number of base 60
        raise FieldError(
            name,
            pairs,
            "does not say from which frame on an episode is solved",
            "write a space after each colon: {0: 120, 3: 95}",
        )
    for episode, frame in pairs.items():
        if not (str(episode).lstrip("-").isdecimal() and float(frame or 0).is_integer()):
            raise FieldError(
                name,
                pairs,
                f"{episode}: {frame} is not an episode and a frame",
                "give whole numbers: {0: 120, 3: 95}",
            )
    return {int(episode): int(frame or 0) for episode, frame in pairs.items()}


def frame_positions(dataset: "LeRobotDataset") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each frame's episode, its place in it, and the episode's length, (N,) each."""
    rows = dataset.hf_dataset.with_format("numpy", columns=["episode_index", "frame_index"])[:]
    _, index, count = np.unique(rows["episode_index"], return_inverse=True, return_counts=True)
    return rows["episode_index"], rows["frame_index"], count[index]


def next_frame_solved(solved: np.ndarray, dataset: "LeRobotDataset") -> np.ndarray:
    """Return for each row whether the next frame of its episode is solved. (N,)

    The frame after an episode's last action is not recorded; it is taken to be like the last one.

    Args:
        solved: whether the task is solved in each row's own frame. (N,)
    """
    _, frame, length = frame_positions(dataset)
    return np.where(frame == length - 1, solved, np.roll(solved, -1))


def longest_run(success: np.ndarray) -> int:
    """Return the largest number of successes in a row. (T,)"""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], success, [False]])))
    return int(np.diff(ends)[::2].max(initial=0))


def duration_lines(runs: Sequence[int]) -> list[str]:
    """Say how long success holds, and with which flags it counts where that is too short.

    runs: the most frames in a row in which the task is solved, of each episode.
    """
    held = np.array([count for count in runs if count])
    if not len(held):
        return []
    lines = [
        f"Success holds for {held.min()} to {held.max()} frames in a row (median {np.median(held):.0f})."
    ]
    if held.min() < DONE_FRAMES:
        short = int((held < DONE_FRAMES).sum())
        lines.append(
            f"{short} of them for fewer than {DONE_FRAMES}: these count with --env.done_frames={held.min()} "
            f"in lerobot-wmrl-train and --done_frames={held.min()} in lerobot-wmrl-eval-world-model."
        )
    return lines


def reach(values: np.ndarray, threshold: float) -> np.ndarray:
    """Mark the values (N,) from `threshold` on. FieldError if one is not a number, or none is so high."""
    if not np.isfinite(values).all():
        frame = int(np.argmin(np.isfinite(values)))
        raise FieldError("threshold", threshold, f"cannot be compared with frame {frame}: {values[frame]}")
    if not (values >= threshold).any():
        raise FieldError(
            "threshold",
            threshold,
            f"no frame reaches it: the values go from {values.min():.3g} to {values.max():.3g}",
            "lower it, or say that every episode fails: --success.type=ends --success.episodes=[]",
        )
    return np.asarray(values >= threshold)
