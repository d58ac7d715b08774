"""A recording that is killed, continued, finished and refused: one small dataset, real simulator."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import planned_parts
from lerobot_dataset_maniskill.recorder import missing_parts, record
from lerobot_dataset_maniskill.simulated import follow_workers
from lerobot_dataset_maniskill.writer import HOLD_FRAMES, find_damage
from lerobot_wmrl.common.constants import KINDS, START_KIND
from lerobot_wmrl.common.output_folders import require_same
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.maniskill.embodiment import STATE_NAMES
from tests.lerobot_dataset_maniskill.made_up import source_of

EPISODES, PART = 6, 2
KIND_SHARES = {"optimal": 0.5, "near_miss": 0.5}
PATIENCE_S = 480.0


def config(root: Path, **fields: object) -> RecordConfig:
    settings = {
        "env": WmrlManiSkillEnv(image_size=64),
        "num_episodes": EPISODES,
        "part_episodes": PART,
        "num_workers": 1,
        "kinds": KIND_SHARES,
    }
    return RecordConfig(output_dir=root / "dataset", **{**settings, **fields})  # type: ignore[arg-type]


def start_and_kill(root: Path, reached: str, workers: int) -> Path:
    """Start the command with so many workers, `kill -9` it once a file like `reached` exists.
    → its folder of unfinished work"""
    flags = [
        f"--num_episodes={EPISODES}",
        f"--part_episodes={PART}",
        f"--num_workers={workers}",
        f"--kinds={json.dumps(KIND_SHARES)}",
        "--env.type=wmrl_maniskill",
        "--env.image_size=64",
        f"--output_dir={root / 'dataset'}",
    ]
    command = subprocess.Popen([sys.executable, "-m", "lerobot_dataset_maniskill.record", *flags])
    work = root / ".dataset.recording"
    deadline = time.monotonic() + PATIENCE_S
    while not any(work.glob(reached)) and time.monotonic() < deadline and command.poll() is None:
        time.sleep(0.02)
    assert command.poll() is None, "the command ended by itself"
    children = psutil.Process(command.pid).children(recursive=True)
    os.kill(command.pid, signal.SIGKILL)
    command.wait()
    _, alive = psutil.wait_procs(children, timeout=PATIENCE_S)
    assert not alive, "the workers outlived the command"
    return work


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished dataset whose recording was killed twice, and whose second part was torn."""
    root = tmp_path_factory.mktemp("recorded")
    for reached, workers in ((".part-*.partial", 1), ("part-00000", 2)):
        work = start_and_kill(root, reached, workers)
    first = (work / "part-00000" / "meta" / "info.json").stat().st_mtime_ns
    torn = work / ".part-00001.1.partial"
    (torn / "meta").mkdir(parents=True, exist_ok=True)
    shutil.copytree(work / "part-00000", work / "part-00002", dirs_exist_ok=True)
    for video in (work / "part-00002").rglob("*.mp4"):
        os.truncate(video, video.stat().st_size // 2)
    assert "part-00000" not in missing_parts(work, source_of(config(root)).parts)
    assert not torn.exists()
    assert not (work / "part-00002").exists()
    assert (work / "part-00000" / "meta" / "info.json").stat().st_mtime_ns == first
    record(config(root))
    assert not work.exists()
    return root


@pytest.fixture(scope="module")
def dataset(recorded: Path) -> LeRobotDataset:
    return LeRobotDataset("local/dataset", root=recorded / "dataset")


def column(dataset: LeRobotDataset, name: str) -> np.ndarray:
    return np.array([np.asarray(value) for value in dataset.hf_dataset[name]])


def test_every_planned_episode_is_there_once_in_order(recorded: Path, dataset: LeRobotDataset) -> None:
    plans = [plan for part in planned_parts(config(recorded)) for plan in part.episodes]
    first = np.flatnonzero(column(dataset, "frame_index") == 0)
    assert column(dataset, "start.seed")[first].ravel().tolist() == [plan.seed for plan in plans]
    assert column(dataset, "start.scene")[first].ravel().tolist() == [plan.scene.index for plan in plans]
    kinds = [KINDS[kind] for kind in column(dataset, "start.kind")[first].ravel()]
    assert kinds == [plan.kind for plan in plans]
    assert find_damage(recorded / "dataset", EPISODES) is None


def test_columns_and_types_are_those_of_the_contract(dataset: LeRobotDataset) -> None:
    row = dataset[0]
    assert row["observation.images.third_view"].shape == (3, 64, 64)
    assert dataset.features["observation.state"]["names"] == list(STATE_NAMES)
    dtypes = {name: feature["dtype"] for name, feature in dataset.features.items()}
    assert dtypes["action"] == dtypes["observation.state"] == dtypes["next.reward"] == "float32"
    assert {dtypes[f"next.{name}"] for name in ("done", "success", "truncated")} == {"bool"}
    assert {dtypes[f"start.{name}"] for name in ("task", "scene", "seed", "kind")} == {"int64"}
    assert "push" in row["task"]


def test_an_optimal_episode_holds_success_a_failure_is_truncated(dataset: LeRobotDataset) -> None:
    episode, done = column(dataset, "episode_index"), column(dataset, "next.done").ravel()
    truncated, success = column(dataset, "next.truncated").ravel(), column(dataset, "next.success").ravel()
    assert np.array_equal(done, success)
    table = read_episodes(dataset)
    kinds, wins = table.columns[START_KIND], table.success
    assert wins[kinds == KINDS.index("optimal")].all()
    for index, won in enumerate(wins):
        rows = np.flatnonzero(episode == index)
        assert truncated[rows[-1]] == (not won)
        assert not truncated[rows[:-1]].any()
        if won:
            assert len(rows) - np.flatnonzero(done[rows])[0] == HOLD_FRAMES + 1


def test_the_same_command_again_says_that_it_is_done(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(config(recorded))
    assert "already recorded" in capsys.readouterr().out


def test_other_settings_and_foreign_folders_are_refused(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"other settings.*seed 0 → 5"):
        record(config(recorded, seed=5))
    stored, other = (config(recorded, video=video).recorded_content() for video in (True, False))
    with pytest.raises(ValueError, match=r"other settings \(video True → False\)"):
        require_same(tmp_path, stored, other)
    (tmp_path / "dataset").mkdir()
    (tmp_path / "dataset" / "thesis.txt").write_text("do not lose")
    with pytest.raises(ValueError, match="holds something else"):
        record(config(tmp_path))
    assert (tmp_path / "dataset" / "thesis.txt").read_text() == "do not lose"


def test_unfinished_work_of_other_settings_is_refused(tmp_path: Path) -> None:
    work = tmp_path / ".dataset.recording"
    (work / "part-00000").mkdir(parents=True)
    (work / "recording.json").write_text(json.dumps(config(tmp_path, seed=5).recorded_content()))
    with pytest.raises(ValueError, match="other settings"):
        record(config(tmp_path))
    assert (work / "part-00000").exists()


def test_a_corrupted_finished_dataset_is_reported(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded / "dataset", tmp_path / "dataset")
    data = next((tmp_path / "dataset" / "data").rglob("*.parquet"))
    os.truncate(data, data.stat().st_size // 2)
    with pytest.raises(ValueError, match=r"corrupted.*record again"):
        record(config(tmp_path))


def test_a_worker_that_is_killed_does_not_leave_the_command_waiting() -> None:
    """It may die with a lock that the others wait for."""
    context = multiprocessing.get_context("spawn")
    killed = context.Process(target=signal.raise_signal, args=(signal.SIGKILL,))
    waiting = context.Process(target=time.sleep, args=(PATIENCE_S,), daemon=True)
    for worker in (killed, waiting):
        worker.start()
    try:
        with pytest.raises(ValueError, match=r"exit statuses -9, None.*run the same command"):
            follow_workers({0}, context.Queue(), [killed, waiting], print)
    finally:
        waiting.kill()
        waiting.join()


def test_stored_images_are_what_the_camera_saw_and_read_like_videos(tmp_path: Path) -> None:
    shown = {}
    for video in (True, False):
        record(config(tmp_path / str(video), num_episodes=2, video=video))
        root = tmp_path / str(video) / "dataset"
        assert (root / "README.md").is_file()
        dataset = open_dataset(root)
        shown[video] = cached_frames(dataset, dataset.meta.camera_keys, 32)[:].astype(int)
        assert bool(list(root.rglob("*.mp4"))) is video
    assert shown[True].shape == shown[False].shape
    difference = np.abs(shown[True] - shown[False])
    assert 0 < difference.mean() < 4, "a video is compressed with losses, an image is not"
