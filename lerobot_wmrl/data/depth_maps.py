"""LeRobot's depth maps, brought to the grid of the tokens: the mean depth in the square that a token is.

Metres, 0 where nothing was measured. N cameras' grids stand one after the other, as their tokens do.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.configs.video import DEPTH_METER_UNIT, DepthEncoderConfig, infer_depth_unit
from lerobot.datasets.depth_utils import MM_PER_METRE, dequantize_depth
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from lerobot_wmrl.data.compatibility import depth_key
from lerobot_wmrl.data.frame_cache import cache_dir, decode_video, digest, file_stamps, memory_map


def token_depth(metres: Tensor, grid: int) -> Tensor:
    """Mean of what was measured (> 0, finite) in each square, 0 where nothing was.

    metres (F, N, H, W) → (F, N·g²)
    """
    known = torch.isfinite(metres) & (metres > 0)
    share = F.adaptive_avg_pool2d(known.float(), grid)
    mean = F.adaptive_avg_pool2d(torch.where(known, metres, 0.0), grid)
    return torch.where(share > 0, mean / share, 0.0).flatten(1)


def cached_depth(dataset: LeRobotDataset, camera_keys: Sequence[str], grid: int) -> np.ndarray:
    """All frames' depth as a read-only memory map, float32 (rows, S) metres; decoded on the first call."""
    keys = [depth_key(camera) for camera in camera_keys]
    key = digest([dataset.num_episodes, dataset.num_frames, grid, *keys, *file_stamps(dataset)])

    def fill(target: np.ndarray) -> None:
        for episode in tqdm(range(dataset.num_episodes), desc="Decoding depth", unit="episode"):
            rows = dataset.meta.episodes[episode]
            maps = torch.cat([decode_depth(dataset, episode, name) for name in keys], 1)
            target[rows["dataset_from_index"] : rows["dataset_to_index"]] = token_depth(maps, grid).numpy()

    shape = (dataset.num_frames, len(keys) * grid**2)
    return memory_map(cache_dir(dataset) / f"depth-{key}.npy", shape, np.float32, fill)


def depth_at(model: Any, dataset: LeRobotDataset, rows: Any) -> Tensor | None:
    """Depth (…, S) of these rows of the dataset on the model's device, None if it does not look at depth."""
    if not model.config.depth:
        return None
    depth = cached_depth(dataset, model.config.tokenizer.camera_keys, model.tokenizer.grid)[rows]
    return torch.from_numpy(np.array(depth)).to(model.state_mean.device)


def decode_depth(dataset: LeRobotDataset, episode: int, key: str) -> Tensor:
    """Depth maps of one episode and camera, (T, 1, H, W) metres, from video or from stored images."""
    info = dataset.features[key].get("info") or {}
    if key in dataset.meta.video_keys:
        codes, encoder = decode_video(dataset, episode, key), DepthEncoderConfig.from_video_info(info)
        metres = dequantize_depth(
            codes, encoder.depth_min, encoder.depth_max, encoder.shift, encoder.use_log,
            output_unit=DEPTH_METER_UNIT,
        )  # fmt: skip
        return torch.where(codes.int() > 0, torch.as_tensor(metres), 0.0)
    rows = dataset.meta.episodes[episode]
    indices = range(rows["dataset_from_index"], rows["dataset_to_index"])
    maps = np.stack([np.asarray(image) for image in dataset.hf_dataset.with_format(None)[indices][key]])
    unit = info.get("depth_unit") or infer_depth_unit(maps.dtype)
    scale = 1.0 if unit == DEPTH_METER_UNIT else 1 / MM_PER_METRE
    return torch.from_numpy(maps.astype(np.float32) * np.float32(scale))[:, None]


def depth_of_windows(batch: Mapping[str, Any], camera_keys: Sequence[str], grid: int) -> Tensor:
    """Of lerobot-train's batch with depth maps (B, T, 1, H, W) in its default unit, millimetres. → (B, T, S)

    ValueError if the depth of a camera is missing.
    """
    missing = [name for name in map(depth_key, camera_keys) if name not in batch]
    if missing:
        raise ValueError(
            f"--reward_model.depth=true: the batch lacks {missing}; use a dataset recorded with --depth=true"
        )
    maps = torch.cat([batch[depth_key(camera)] for camera in camera_keys], 2).float() / MM_PER_METRE
    return token_depth(maps.flatten(0, 1), grid).unflatten(0, maps.shape[:2])
