"""What is read from a dataset beside its pictures."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.lerobot_commands import edit_advice
from lerobot_wmrl.data.checks import frame_size, require_shown
from lerobot_wmrl.data.dataset import DatasetSource, fingerprint, open_dataset
from lerobot_wmrl.data.episodes import read_episodes

FEATURES = {"action": {"dtype": "float32", "shape": (1,), "names": ["x"]}}


def record(root: Path, episodes: list[list[str]]) -> Path:
    """Record episodes with an instruction for each frame, with LeRobot's own functions."""
    dataset = LeRobotDataset.create("local/tasks", 10, FEATURES, root=root)
    for instructions in episodes:
        for instruction in instructions:
            dataset.add_frame({"action": np.zeros(1, np.float32), "task": instruction})
        dataset.save_episode()
    dataset.finalize()
    return root


def test_the_instruction_of_an_episode_is_that_of_its_first_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    table = read_episodes(open_dataset(record(tmp_path / "one", [["open", "open"], ["close"]])))
    assert table.instructions == ["open", "close"]
    assert "the instruction changes" not in caplog.text
    several = record(tmp_path / "several", [["open", "open"], ["close", "open", "lift"]])
    assert read_episodes(open_dataset(several)).instructions == ["open", "close"]
    assert "the instruction changes within 1 of 2 episodes" in caplog.text


def test_where_episodes_merely_end_nothing_is_added(tmp_path: Path) -> None:
    """`next.done` alone may mark timeouts."""
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create("local/ends", 10, FEATURES | {"next.done": flag}, root=tmp_path / "d")
    for step in range(5):
        dataset.add_frame(
            {"action": np.zeros(1, np.float32), "next.done": np.array([step == 4]), "task": "open"}
        )
    dataset.save_episode()
    dataset.finalize()
    table = read_episodes(open_dataset(tmp_path / "d"))
    assert table.success_target.tolist() == [False] * 4 + [True]
    with pytest.raises(FieldError, match=r"next.done is true in the last rows .* no frame shows success"):
        require_shown(table, [0])


def test_a_frame_shows_success_after_the_action_that_leads_to_it(tmp_path: Path) -> None:
    table = read_episodes(open_dataset(record(tmp_path / "one", [["open"] * 4, ["open"] * 3])))
    table.done[[1, 3, 4]] = True
    assert table.shown.astype(int).tolist() == [0, 0, 1, 0, 0, 1, 0]
    assert [table.shows_success([episode]) for episode in (0, 1)] == [True, True]
    require_shown(table, [0, 1])


@pytest.mark.parametrize(
    ("shape", "names"),
    [
        ((48, 64, 3), ["height", "width", "channels"]),
        ((48, 64, 3), ["height", "width", "channel"]),
        ((3, 48, 64), ["channels", "height", "width"]),
        ((48, 64, 3), ["height", "width", "rgb"]),
        ((3, 48, 64), ["c", "h", "w"]),
        ((48, 64, 3), None),
        ((48, 64, 1), ["height", "width", "depth"]),
    ],
)
def test_the_size_of_frames_is_read_whatever_their_channels_are_called(
    shape: tuple[int, ...], names: list[str] | None
) -> None:
    assert frame_size({"shape": shape, "names": names}) == (48, 64)


def test_a_folder_is_the_same_with_and_without_a_slash() -> None:
    assert DatasetSource("data/x/") == DatasetSource("data/x")
    assert not DatasetSource().given


def test_the_fingerprint_changes_with_columns_and_not_with_a_copy(
    make_synthetic_dataset: Callable[..., LeRobotDataset], tmp_path: Path
) -> None:
    root = Path(make_synthetic_dataset(tmp_path / "one").root)
    shutil.copytree(root, tmp_path / "copy")
    before = fingerprint(root)
    assert fingerprint(tmp_path / "copy") == before
    stats = root / "meta" / "stats.json"
    stats.write_text(stats.read_text().replace("next.success", "next.failure"))
    assert fingerprint(root) != before


@pytest.mark.parametrize(
    ("recorded", "read"),
    [
        ([[0, 0, 0, 0, 1], [0, 0], [1]], [[0, 0, 1, 1, 1], [0, 0], [1]]),
        ([[0, 0, 0, 0, 1], [0, 1, 1]], [[0, 0, 0, 0, 1], [0, 1, 1]]),
        ([[0, 0, 0, 1, 0], [0, 0, 1]], [[0, 0, 0, 1, 0], [0, 0, 1]]),
        ([[0, 0], [0]], [[0, 0], [0]]),
        ([[0, 0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 1, 1]], [[0, 0, 1, 1, 1], [0, 1, 1, 1], [0, 0, 1, 1]]),
    ],
    ids=["all end at success", "one holds it", "one goes on", "none succeeds", "most end at success"],
)
def test_where_no_frame_shows_success_the_last_ones_are_taken_for_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, recorded: list[list[int]], read: list[list[int]]
) -> None:
    """LeRobot's environments end an episode at its first success; the picture after it is not recorded."""
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create("local/ends", 10, FEATURES | {"next.success": flag}, root=tmp_path / "d")
    for episode in recorded:
        for success in episode:
            dataset.add_frame(
                {"action": np.zeros(1, np.float32), "next.success": np.array([bool(success)]), "task": "open"}
            )
        dataset.save_episode()
    dataset.finalize()
    table = read_episodes(open_dataset(tmp_path / "d"))
    assert table.success_target.astype(int).tolist() == [frame for episode in read for frame in episode]
    assert table.done.astype(int).tolist() == [frame for episode in recorded for frame in episode]
    assert table.success.tolist() == [any(episode) for episode in recorded]
    assert ("no frame shows success" in caplog.text) == (recorded != read)


def test_a_dataset_behind_links_is_the_same_data(small_dataset, tmp_path):
    """Its rows too: LeRobot follows a link to a folder."""
    shutil.copytree(small_dataset.root, tmp_path / "data")
    chunk = tmp_path / "data" / "data" / "chunk-000"
    chunk.rename(tmp_path / "elsewhere")
    chunk.symlink_to(tmp_path / "elsewhere")
    assert fingerprint(tmp_path / "data") == fingerprint(Path(small_dataset.root))
    assert read_episodes(open_dataset(tmp_path / "data")).length.tolist() == [
        int(length) for length in small_dataset.meta.episodes["length"]
    ]


def test_the_folder_that_one_is_in_is_a_dataset(small_dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(small_dataset.root)
    assert DatasetSource(root=".").open().num_episodes == small_dataset.num_episodes
    advice = edit_advice(".", "remove_feature", {"operation.feature_names": ["next.success"]})
    assert f"--root={small_dataset.root} " in advice
    assert f"--new_root={small_dataset.root}_edited" in advice
    with pytest.raises(FieldError, match=r"^dataset\.root=: no dataset is named; give `dataset\.root` or"):
        DatasetSource().open()


def test_actions_that_are_no_vectors_are_refused(small_dataset):
    dataset = open_dataset(small_dataset.root)
    dataset.meta.info.features["action"]["shape"] = (2, 3)
    with pytest.raises(FieldError, match=r"action has the shape \(2, 3\), which is no vector"):
        read_episodes(dataset)
