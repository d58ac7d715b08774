"""Copies of a dataset in which episodes have each other's labels or actions."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from experiments.shuffled import shuffle
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.episodes import EpisodeTable, open_dataset, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames

CAMERA = "observation.images.third_view"


def per_episode(table: EpisodeTable, values: np.ndarray) -> list[np.ndarray]:
    return [values[start : start + n] for start, n in zip(table.start, table.length, strict=True)]


@pytest.mark.parametrize("what", ["labels", "actions"])
def test_episodes_take_each_others_labels_or_actions_and_nothing_else(
    small_dataset: LeRobotDataset, tmp_path: Path, what: str
):
    before = read_episodes(small_dataset)
    after = read_episodes(shuffle(Path(small_dataset.root), tmp_path / "copy", what, seed=0))
    same, moved = (before.action, after.action), (before.done, after.done)
    if what == "actions":
        same, moved = moved, same
    assert np.array_equal(*same)
    assert not np.array_equal(*moved)
    assert np.array_equal(before.state, after.state)
    assert np.array_equal(cached_frames(before.dataset, [CAMERA]), cached_frames(after.dataset, [CAMERA]))
    if what == "labels":
        assert sorted(before.success) == sorted(after.success)
        assert not np.array_equal(before.success, after.success)
    else:
        firsts = [{tuple(actions[0]) for actions in per_episode(t, t.action)} for t in (before, after)]
        assert firsts[0] == firsts[1]


def test_labels_are_aligned_at_the_ends_of_episodes(small_dataset: LeRobotDataset, tmp_path: Path):
    """An episode still ends in success, if it has any."""
    table = read_episodes(shuffle(Path(small_dataset.root), tmp_path / "copy", "labels", seed=1))
    ends = [done[-1] for done in per_episode(table, table.done)]
    assert np.array_equal(ends, table.success)
    assert any(ends)


def test_a_seed_gives_one_shuffle_and_nothing_is_overwritten(small_dataset: LeRobotDataset, tmp_path: Path):
    root = Path(small_dataset.root)
    first, again, other = (
        read_episodes(shuffle(root, tmp_path / name, "actions", seed)).action
        for name, seed in (("first", 0), ("again", 0), ("other", 1))
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    with pytest.raises(FieldError, match="exists"):
        shuffle(root, tmp_path / "first", "actions", 0)
    assert read_episodes(open_dataset(root)).dataset.num_episodes == small_dataset.num_episodes
