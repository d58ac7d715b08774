"""lerobot-wmrl-resample: what is kept, what is added up, and what is refused."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.dataset_tools import remove_feature
from lerobot.datasets.language import language_feature_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.writer import video_encoder
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data import decoding
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.scripts import resample as command
from lerobot_wmrl.scripts.resample import ResampleConfig, check, end_of, main

LENGTHS, FPS, SIDE = (7, 4), 50, 8
CAMERA = "observation.images.top"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes in which every number tells its frame; success holds in frame 3 alone."""
    root = tmp_path_factory.mktemp("resample") / "fast"
    bound = {"low": [-1.0, 0.0], "high": [1.0, 500.0]}
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": (2,), "names": ["dx", "target"], "info": bound},
        "observation.state": {"dtype": "float32", "shape": (1,), "names": ["x"]},
        CAMERA: {"dtype": "image", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        "next.done": {"dtype": "int64", "shape": (1,), "names": None},
        "pose": {"dtype": "float64", "shape": (2, 3), "names": None},
        "note": {"dtype": "string", "shape": (1,), "names": None},
        "next.note": {"dtype": "string", "shape": (1,), "names": None},
        "start.seed": {"dtype": "int64", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("local/fast", FPS, features, root=root, use_videos=False)
    for episode, length in enumerate(LENGTHS):
        for frame in range(length):
            dataset.add_frame(
                {
                    "action": np.array([0.1, 10 * frame], np.float32),
                    "task": f"task {episode}",
                    "observation.state": np.array([frame], np.float32),
                    CAMERA: np.full((SIDE, SIDE, 3), 20 * frame, np.uint8),
                    "next.reward": np.array([1], np.float32),
                    "next.success": np.array([frame == 3]),
                    "next.done": np.array([frame == length - 1], np.int64),
                    "pose": np.full((2, 3), frame + 0.1),
                    "note": f"frame {frame}",
                    "next.note": f"after {frame}",
                    "start.seed": np.array([5 + episode]),
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def resample(monkeypatch: pytest.MonkeyPatch, *flags: str) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-resample", *flags])
    main()


def test_what_happened_between_two_kept_frames_belongs_to_the_first(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    slow = tmp_path / "slow"
    monkeypatch.setattr(decoding, "DECODED", 3)  # frames that are decoded at a time
    resample(
        monkeypatch, f"--dataset.root={source}", "--every=2", "--displacements=[dx]", f"--output_dir={slow}"
    )
    said = capsys.readouterr().out
    assert "2 episodes, 6 frames at 25 Hz, the longest has 4" in said
    assert "Success holds for 1 to 1 frames in a row" in said
    assert "2 of them for fewer than 3: these count with --env.done_frames=1" in said
    dataset = open_dataset(slow)
    table = read_episodes(dataset)
    assert (dataset.fps, table.length.tolist()) == (25, [4, 2])
    np.testing.assert_allclose(table.action[:4], [[0.2, 10], [0.2, 30], [0.2, 50], [0.1, 60]], rtol=1e-6)
    assert table.state[:, 0].tolist() == [0, 2, 4, 6, 0, 2]
    assert table.done.tolist() == [False, True, False, False, False, True]
    assert table.instructions == ["task 0", "task 1"]
    assert table.column("start.seed").tolist() == [5, 6]
    rows = dataset.hf_dataset.with_format("numpy")
    assert list(rows["note"])[:2] == ["frame 0", "frame 2"]
    assert list(rows["next.note"])[:2] == ["after 1", "after 3"]
    assert np.ravel(rows["next.done"]).tolist() == [0, 0, 0, 1, 0, 1]
    np.testing.assert_array_equal(dataset.hf_dataset.with_format(None)[5]["pose"], np.full((2, 3), 2.1))
    assert np.ravel(rows["next.reward"]).tolist() == [2, 2, 2, 1, 2, 2]
    assert [round(float(dataset[row][CAMERA].mean()) * 255) for row in range(4)] == [0, 40, 80, 120]
    assert dataset.features["action"]["info"] == {"low": [-2, 0], "high": [2, 500]}


def test_what_follows_success_is_cut_off(
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Frame 3 alone is solved: of seven frames four are left, and four of four. No action adds up."""
    cut = tmp_path / "cut"
    monkeypatch.setattr(command, "absolute_control", lambda table: False)
    monkeypatch.setattr(decoding, "DECODED", 3)
    resample(monkeypatch, f"--dataset.root={source}", "--every=1", "--solved_frames=1", f"--output_dir={cut}")
    assert "1 episodes were cut, by 3 frames together" in capsys.readouterr().out
    assert "do not follow the state" not in caplog.text
    dataset = open_dataset(cut)
    assert (dataset.fps, read_episodes(dataset).length.tolist()) == (FPS, [4, 4])
    rows = dataset.hf_dataset.with_format("numpy")
    assert np.ravel(rows["next.done"]).tolist() == [0, 0, 0, 1, 0, 0, 0, 1]
    assert np.ravel(rows["next.success"]).tolist() == [False, False, False, True] * 2
    assert [round(float(dataset[row][CAMERA].mean()) * 255) for row in range(4)] == [0, 20, 40, 60]


@pytest.mark.parametrize(("frames", "rows"), [(1, 2), (2, 6), (3, 7), (4, 8)])
def test_an_episode_ends_after_so_many_solved_frames_in_a_row(frames: int, rows: int) -> None:
    """One that has not as many is kept whole."""
    assert end_of(np.array([0, 1, 0, 0, 1, 1, 1, 0], bool), frames) == rows


def test_episodes_without_labels_are_not_cut(source: Path, tmp_path: Path) -> None:
    bare = remove_feature(open_dataset(source), "next.success", output_dir=tmp_path / "bare")
    with pytest.raises(FieldError, match=r"^solved_frames=4: .*label it first"):
        check(ResampleConfig(output_dir=tmp_path / "cut", every=1, solved_frames=4), bare)


def test_episodes_that_only_end_are_no_successes(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    remove_feature(open_dataset(source), "next.success", output_dir=tmp_path / "ends", repo_id="local/ends")
    resample(monkeypatch, f"--dataset.root={tmp_path / 'ends'}", f"--output_dir={tmp_path / 'slow'}")
    assert "Success holds" not in capsys.readouterr().out


def test_depth_is_refused(make_synthetic_dataset: Any, tmp_path: Path, monkeypatch, capsys) -> None:
    deep = make_synthetic_dataset(tmp_path / "deep", episodes=1, depth=True)
    with pytest.raises(SystemExit):
        resample(monkeypatch, f"--dataset.root={deep.root}", "--every=5", f"--output_dir={tmp_path / 'slow'}")
    assert "has depth (observation.images.third_view_depth), which is not copied" in capsys.readouterr().err


def test_annotations_are_refused(make_synthetic_dataset: Any, tmp_path: Path) -> None:
    """LeRobot's language columns."""
    told = make_synthetic_dataset(tmp_path / "told", episodes=1)
    told.features.update(language_feature_info())
    with pytest.raises(FieldError, match=r"has annotations \(language_persistent, language_events\)"):
        check(ResampleConfig(output_dir=tmp_path / "slow", every=5), told)


def test_videos_stay_videos(make_synthetic_dataset: Any, tmp_path: Path, monkeypatch) -> None:
    fast = make_synthetic_dataset(tmp_path / "fast", episodes=1)
    resample(monkeypatch, f"--dataset.root={fast.root}", "--every=5", f"--output_dir={tmp_path / 'slow'}")
    slow = open_dataset(tmp_path / "slow")
    assert slow.meta.video_keys == fast.meta.video_keys
    key = slow.meta.video_keys[0]
    far = [float((slow[1][key] - fast[row][key]).abs().mean()) for row in (0, 5, 10)]
    assert np.argmin(far) == 1


def test_videos_are_encoded_as_they_were(tmp_path: Path, monkeypatch) -> None:
    """LeRobot's default encoding loses much of small frames."""
    features = {
        "observation.images.top": {
            "dtype": "video",
            "shape": (64, 64, 3),
            "names": ["height", "width", "channels"],
        },
        "action": {"dtype": "float32", "shape": (1,), "names": ["x"]},
    }
    root = tmp_path / "fast"
    fast = LeRobotDataset.create("local/fast", 10, features, root=root, rgb_encoder=video_encoder())
    pictures = np.random.default_rng(0).integers(0, 256, (4, 8, 8, 3), np.uint8).repeat(8, 1).repeat(8, 2)
    for picture in pictures:
        fast.add_frame({"observation.images.top": picture, "action": np.zeros(1, np.float32), "task": "x"})
    fast.save_episode()
    fast.finalize()
    resample(monkeypatch, f"--dataset.root={root}", "--every=2", f"--output_dir={tmp_path / 'slow'}")
    copied = open_dataset(tmp_path / "slow")[1]["observation.images.top"].permute(1, 2, 0).numpy()
    assert np.abs(255 * copied - pictures[2]).mean() < 3


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--every=1"], "--every=1: must be at least 2"),
        (["--every=3"], "--every=3: does not divide the dataset's 50 frames a second"),
        (["--displacements=[dy]"], "--displacements=dy: the action has no such component; choose from"),
        (["--output_dir={source}"], "there is something already"),
    ],
)
def test_what_cannot_be_is_refused(
    flags: list[str],
    message: str,
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = [flag.format(source=source) for flag in flags]
    with pytest.raises(SystemExit):
        resample(monkeypatch, f"--dataset.root={source}", f"--output_dir={tmp_path / 'slow'}", *given)
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
