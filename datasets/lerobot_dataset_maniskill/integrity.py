"""Whether a dataset on disk is whole, without decoding its pictures."""

import json
from pathlib import Path

import av
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_wmrl.data.episodes import parquet_files


def whole_dataset(root: Path, episodes: int) -> str | None:
    """What is wrong with the dataset at `root`, or None if it has `episodes` whole episodes."""
    try:
        return _first_problem(root, episodes)
    except (OSError, ValueError, KeyError, pa.ArrowException, av.FFmpegError) as error:
        return f"corrupted: {error}"


def _first_problem(root: Path, episodes: int) -> str | None:
    """Raises where a file is missing or unreadable."""
    info = json.loads((root / "meta" / "info.json").read_text())
    if info["total_episodes"] != episodes:
        return f"it has {info['total_episodes']} of {episodes} episodes"
    rows = sum(len(pq.read_table(path, columns=["index"])) for path in parquet_files(root))
    if rows != info["total_frames"]:
        return f"it has {rows} of {info['total_frames']} rows"
    for camera in (name for name, feature in info["features"].items() if feature["dtype"] == "video"):
        frames = sum(video_frames(path) for path in sorted((root / "videos" / camera).rglob("*.mp4")))
        if frames != rows:
            return f"{camera} has {frames} of {rows} frames"
    return None


def video_frames(path: Path) -> int:
    """Frames in a video file, counted by its packets, so that a truncated file shows."""
    container = av.open(str(path))
    try:
        return sum(packet.size > 0 for packet in container.demux(video=0))
    finally:
        container.close()
