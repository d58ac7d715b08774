"""The dataset's files: its columns, one row per control step, its vocabulary, and a check that it is
whole."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs.video import DepthEncoderConfig, RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.manifest import EpisodePlan
from lerobot_wmrl.common.constants import KINDS, START_COLUMNS, TASK_NAMES
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.data.embodiment import HIGH, LOW
from lerobot_wmrl.data.episodes import parquet_files
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, ACTION_NAMES, FPS, STATE_NAMES
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.scenes import SCENES

HOLD_FRAMES = 5
"""Rows that a successful episode continues after the one whose action first succeeded."""

VOCABULARY_FILE = Path("meta/wmrl.json")


def video_encoder() -> RGBEncoderConfig:
    """Return H.264 without chroma subsampling: 45 dB on 64x64 frames, where the default has 33 dB."""
    return RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=12, preset="ultrafast", g=2)


def depth_encoder() -> DepthEncoderConfig:
    """Return a lossless encoder in steps of 0.6 mm up to 2.5 m; only background is further away."""
    quiet = {"x265-params": "lossless=1:log-level=none"}
    return DepthEncoderConfig(depth_min=0.0, depth_max=2.5, use_log=False, extra_options=quiet)


def dataset_features(
    cameras: Sequence[str], image_size: int, depth: bool, video: bool = True
) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns. Depth is always video."""
    kind = "video" if video else "image"
    camera_columns = {
        f"observation.images.{camera}": _camera_feature(kind, image_size, 3) for camera in cameras
    }
    if depth:
        camera_columns |= {
            f"observation.images.{camera}_depth": _camera_feature("video", image_size, 1)
            for camera in cameras
        }
    scalars = {
        "next.reward": "float32",
        "next.done": "bool",
        "next.success": "bool",
        "next.truncated": "bool",
    }
    scalars |= dict.fromkeys(START_COLUMNS, "int64")
    return {
        **camera_columns,
        "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
        "action": {
            "dtype": "float32",
            "shape": (len(ACTION_NAMES),),
            "names": list(ACTION_NAMES),
            "info": {LOW: list(ACTION_LOW), HIGH: list(ACTION_HIGH)},
        },
        **{name: {"dtype": dtype, "shape": (1,), "names": None} for name, dtype in scalars.items()},
    }


def _camera_feature(kind: str, image_size: int, channels: int) -> dict[str, Any]:
    """Return the description of a camera's column; one channel is depth."""
    shape = (image_size, image_size, channels)
    info = {"info": {"is_depth_map": True}} if channels == 1 else {}
    return {"dtype": kind, "shape": shape, "names": ["height", "width", "channels"], **info}


def create_dataset(
    root: Path,
    repo_id: str,
    cameras: Sequence[str],
    image_size: int,
    depth: bool = False,
    video: bool = True,
) -> LeRobotDataset:
    """Create an empty dataset at `root`, which must not exist."""
    return LeRobotDataset.create(
        repo_id,
        FPS,
        dataset_features(cameras, image_size, depth, video),
        root=root,
        robot_type="panda",
        use_videos=video or depth,
        streaming_encoding=True,
        encoder_queue_maxsize=0,  # without a limit: where there is one, LeRobot drops the frames beyond it
        encoder_threads=1,
        rgb_encoder=video_encoder(),
        depth_encoder=depth_encoder(),
    )


@dataclass(frozen=True)
class StartColumns:
    """The columns that are the same in every row of an episode."""

    instruction: str
    task_index: int
    plan: EpisodePlan

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns of `constants.START_COLUMNS`, each (1,) int64."""
        plan = self.plan
        values = (self.task_index, plan.scene.index, plan.seed, KINDS.index(plan.kind))
        return {name: np.array([value], np.int64) for name, value in zip(START_COLUMNS, values, strict=True)}


@dataclass(frozen=True)
class StepResult:
    """The frame that an action led to, and whether the episode was truncated there."""

    frame: Frame
    truncated: bool


def add_step(
    dataset: LeRobotDataset, start: StartColumns, before: Frame, action: np.ndarray, result: StepResult
) -> None:
    """Add one row: the frame, the commanded action, and the outcome in the frame that it led to."""
    dataset.add_frame(
        {
            **{f"observation.images.{camera}": image for camera, image in before.images.items()},
            **{f"observation.images.{camera}_depth": image for camera, image in before.depth.items()},
            "observation.state": before.state,
            "action": np.asarray(action, np.float32),
            "next.reward": np.array([result.frame.reward], np.float32),
            "next.done": np.array([result.frame.success]),
            "next.success": np.array([result.frame.success]),
            "next.truncated": np.array([result.truncated]),
            **start.columns(),
            "task": start.instruction,
        }
    )


def write_vocabulary(root: Path, recording: Mapping[str, Any]) -> None:
    """Write `meta/wmrl.json`: what the integer columns and the action mean, and what was recorded."""
    write_json(
        root / VOCABULARY_FILE,
        {
            "tasks": list(TASK_NAMES),
            "kinds": list(KINDS),
            "scenes": [scene.as_json() for scene in SCENES],
            "action_low": list(ACTION_LOW),
            "action_high": list(ACTION_HIGH),
            "hold_frames": HOLD_FRAMES,
            "image_size": recording["image_size"],
            "cameras": list(recording["cameras"]),
            "recording": dict(recording),
        },
    )


def find_damage(root: Path, episodes: int) -> str | None:
    """Check a dataset without decoding its pictures.

    Args:
        root: root of the dataset.
        episodes: how many it should have.

    Returns:
        What is wrong, or None if all episodes are whole.
    """
    try:
        return _first_damage(root, episodes)
    except (OSError, ValueError, KeyError, pa.ArrowException, av.FFmpegError) as error:
        return f"corrupted: {error}"


def _first_damage(root: Path, episodes: int) -> str | None:
    """Return what is wrong; raise where a file is missing or unreadable."""
    info = json.loads((root / "meta" / "info.json").read_text())
    if info["total_episodes"] != episodes:
        return f"it has {info['total_episodes']} of {episodes} episodes"
    rows = sum(len(pq.read_table(path, columns=["index"])) for path in parquet_files(root))
    if rows != info["total_frames"]:
        return f"it has {rows} of {info['total_frames']} rows"
    for camera in (name for name, feature in info["features"].items() if feature["dtype"] == "video"):
        frames = sum(count_video_frames(path) for path in sorted((root / "videos" / camera).rglob("*.mp4")))
        if frames != rows:
            return f"{camera} has {frames} of {rows} frames"
    return None


def count_video_frames(path: Path) -> int:
    """Count the frames in a video file by its packets, which shows a truncated file."""
    container = av.open(str(path))
    try:
        return sum(packet.size > 0 for packet in container.demux(video=0))
    finally:
        container.close()
