"""Copies of a dataset in which episodes have each other's labels or actions."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from experiments.steps.shuffled import donor_rows, shuffle
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
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
    assert np.array_equal(*(cached_frames(each.dataset, [CAMERA], 32) for each in (before, after)))
    if what == "labels":
        assert sorted(before.success) == sorted(after.success)
        assert not np.array_equal(before.success, after.success)
    else:
        firsts = [{tuple(actions[0]) for actions in per_episode(t, t.action)} for t in (before, after)]
        assert firsts[0] == firsts[1]


@pytest.mark.parametrize("seed", range(5))
def test_every_episode_takes_from_the_beginning_of_another(small_dataset: LeRobotDataset, seed: int):
    table = read_episodes(small_dataset)
    episode = np.repeat(np.arange(len(table.start)), table.length)
    rows = donor_rows(table, seed)
    assert (episode[rows] != episode).all()
    assert np.array_equal(rows[table.start], table.start[episode[rows[table.start]]])
    assert sorted(episode[rows[table.start]]) == list(range(len(table.start)))


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
