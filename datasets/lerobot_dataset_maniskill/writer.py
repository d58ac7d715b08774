"""The LeRobotDataset side: features, one row a control step, vocabulary."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.video import DepthEncoderConfig, RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.manifest import EpisodePlan
from lerobot_wmrl.common.constants import (
    ACTION_HIGH,
    ACTION_LOW,
    ACTION_NAMES,
    FPS,
    KINDS,
    START_COLUMNS,
    STATE_NAMES,
    TASKS,
)
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.scenes import SCENES

HOLD_FRAMES = 5
"""A successful episode goes on for so many rows after the one whose action first succeeded."""

VOCABULARY_FILE = Path("meta/wmrl.json")


def video_encoder() -> RGBEncoderConfig:
    """H.264 without chroma subsampling: 45 dB on 64x64 frames, as fast as the default that reaches 33 dB."""
    return RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=12, preset="ultrafast", g=2)


def depth_encoder() -> DepthEncoderConfig:
    """Lossless, in steps of 0.6 mm up to 2.5 m: further away is only background."""
    quiet = {"x265-params": "lossless=1:log-level=none"}
    return DepthEncoderConfig(depth_min=0.0, depth_max=2.5, use_log=False, extra_options=quiet)


def dataset_features(cameras: Sequence[str], image_size: int, depth: bool) -> dict[str, dict[str, Any]]:
    """LeRobot's description of the columns."""
    pictures = {f"observation.images.{camera}": _picture(image_size, 3) for camera in cameras}
    if depth:
        pictures |= {f"observation.images.{camera}_depth": _picture(image_size, 1) for camera in cameras}
    scalars = {
        "next.reward": "float32",
        "next.done": "bool",
        "next.success": "bool",
        "next.truncated": "bool",
    }
    scalars |= dict.fromkeys(START_COLUMNS, "int64")
    return {
        **pictures,
        "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
        "action": {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": list(ACTION_NAMES)},
        **{name: {"dtype": dtype, "shape": (1,), "names": None} for name, dtype in scalars.items()},
    }


def _picture(image_size: int, channels: int) -> dict[str, Any]:
    """A square picture; one channel is depth."""
    shape = (image_size, image_size, channels)
    info = {"info": {"is_depth_map": True}} if channels == 1 else {}
    return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], **info}


def create_dataset(
    root: Path, repo_id: str, cameras: Sequence[str], image_size: int, depth: bool = False
) -> LeRobotDataset:
    """An empty dataset at `root`, which must not exist."""
    return LeRobotDataset.create(
        repo_id, FPS, dataset_features(cameras, image_size, depth), root=root, robot_type="panda",
        use_videos=True, streaming_encoding=True, encoder_threads=1,
        rgb_encoder=video_encoder(), depth_encoder=depth_encoder(),
    )  # fmt: skip


@dataclass(frozen=True)
class StartColumns:
    """What is the same in every row of an episode."""

    instruction: str
    task_index: int
    plan: EpisodePlan

    def columns(self) -> dict[str, np.ndarray]:
        """The columns of `constants.START_COLUMNS`, each (1,) int64."""
        plan = self.plan
        values = (self.task_index, plan.scene.index, plan.seed, KINDS.index(plan.kind))
        return {name: np.array([value], np.int64) for name, value in zip(START_COLUMNS, values, strict=True)}


@dataclass(frozen=True)
class Outcome:
    """The frame an action led to, and whether the episode was cut there."""

    frame: Frame
    truncated: bool


def add_step(
    dataset: LeRobotDataset, start: StartColumns, before: Frame, action: np.ndarray, outcome: Outcome
) -> None:
    """One row: what was seen, the commanded action, and the outcome in the frame it led to."""
    dataset.add_frame(
        {
            **{f"observation.images.{camera}": image for camera, image in before.images.items()},
            **{f"observation.images.{camera}_depth": image for camera, image in before.depth.items()},
            "observation.state": before.state,
            "action": np.asarray(action, np.float32),
            "next.reward": np.array([outcome.frame.reward], np.float32),
            "next.done": np.array([outcome.frame.success]),
            "next.success": np.array([outcome.frame.success]),
            "next.truncated": np.array([outcome.truncated]),
            **start.columns(),
            "task": start.instruction,
        }
    )


def write_vocabulary(root: Path, recording: Mapping[str, Any]) -> None:
    """`meta/wmrl.json`: what the integer columns and the action mean, and what was recorded."""
    write_json(
        root / VOCABULARY_FILE,
        {
            "tasks": list(TASKS),
            "kinds": list(KINDS),
            "scenes": [vars(scene) for scene in SCENES],
            "action_low": list(ACTION_LOW),
            "action_high": list(ACTION_HIGH),
            "hold_frames": HOLD_FRAMES,
            "image_size": recording["image_size"],
            "cameras": list(recording["cameras"]),
            "recording": dict(recording),
        },
    )
