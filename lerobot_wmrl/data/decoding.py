"""Frames and depth of a LeRobotDataset's episodes, decoded from video or from stored images."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.video import DEPTH_METER_UNIT, DepthEncoderConfig, infer_depth_unit
from lerobot.datasets.depth_utils import MM_PER_METRE, dequantize_depth
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import FrameTimestampError, decode_video_frames
from torch import Tensor

from lerobot_wmrl.data.dataset import VIDEO_BACKEND

NEAREST = 0.25
"""How far a frame of a video may be from its time, as a share of the time between two: less than half of it,
so that it is no other's."""

DECODED = 256
"""Frames of a camera that are decoded at a time: those of a long episode would not fit into the memory."""


def rows_of(dataset: LeRobotDataset, episode: int) -> slice:
    """Return where an episode has its frames."""
    rows = dataset.meta.episodes[episode]
    return slice(rows["dataset_from_index"], rows["dataset_to_index"])


def row_parts(dataset: LeRobotDataset, episode: int) -> list[slice]:
    """Return an episode's rows in parts whose frames are decoded at once."""
    rows = rows_of(dataset, episode)
    return [slice(first, min(first + DECODED, rows.stop)) for first in range(rows.start, rows.stop, DECODED)]


def decode(dataset: LeRobotDataset, episode: int, key: str, rows: slice) -> Tensor:
    """Decode some rows of an episode, which are the dataset's, in one camera: uint8 (T, 3, H, W)."""
    if key not in dataset.meta.video_keys:
        frames = np.stack([np.asarray(image.convert("RGB")) for image in stored_images(dataset, key, rows)])
        return torch.from_numpy(frames).permute(0, 3, 1, 2)
    return decode_video(dataset, episode, key, rows)


def stored_images(dataset: LeRobotDataset, key: str, rows: slice) -> list[Any]:
    """Return rows of a camera that the dataset stores as images, as PIL opens them."""
    images: list[Any] = dataset.hf_dataset.with_format(None, columns=[key])[rows][key]
    return images


def decode_video(dataset: LeRobotDataset, episode: int, key: str, rows: slice) -> Tensor:
    """Decode rows of an episode from a camera's video: uint8 (T, 3, H, W), or codes of depth (T, 1, H, W).

    Raises:
        ValueError: the video is corrupted.
    """
    begin = rows_of(dataset, episode).start
    first = dataset.meta.episodes[episode][f"videos/{key}/from_timestamp"]
    times = [first + index / dataset.fps for index in range(rows.start - begin, rows.stop - begin)]
    path = Path(dataset.root) / dataset.meta.get_video_file_path(episode, key)
    try:
        return decode_video_frames(
            path,
            times,
            max(dataset.tolerance_s, NEAREST / dataset.fps),
            VIDEO_BACKEND,
            return_uint8=True,
            is_depth=key in dataset.meta.depth_keys,
        )
    except FrameTimestampError as error:
        raise ValueError(
            f"dataset {dataset.root}: episode {episode}: {key}: {path.name} has no frame at the time of some "
            f"row from {rows.start} to {rows.stop - 1}, to a quarter of the time between two. See that video "
            "and rows belong together: copy or download the dataset again, or remove the episode"
        ) from error
    except Exception as error:
        raise ValueError(
            f"dataset {dataset.root}: episode {episode}: {key}: {path.name} cannot be decoded ({error}). If "
            "`ffprobe` cannot read it either, copy or download this file again, and only if there is no "
            "other copy, record it again"
        ) from error


def decode_depth(dataset: LeRobotDataset, episode: int, key: str, rows: slice) -> Tensor:
    """Decode the depth of some rows of an episode in one camera, (T, 1, H, W) metres."""
    info = dataset.features[key].get("info") or {}
    if key in dataset.meta.video_keys:
        codes = decode_video(dataset, episode, key, rows)
        encoder = DepthEncoderConfig.from_video_info(info)
        metres = dequantize_depth(
            codes,
            encoder.depth_min,
            encoder.depth_max,
            encoder.shift,
            encoder.use_log,
            output_unit=DEPTH_METER_UNIT,
        )
        return torch.where(codes.int() > 0, torch.as_tensor(metres), 0.0)
    maps = np.stack([np.asarray(image) for image in stored_images(dataset, key, rows)])
    unit = info.get("depth_unit") or infer_depth_unit(maps.dtype)
    scale = 1.0 if unit == DEPTH_METER_UNIT else 1 / MM_PER_METRE
    return torch.from_numpy(maps.astype(np.float32) * np.float32(scale))[:, None]
