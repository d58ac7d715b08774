"""Frames and depth decoded once, tokens encoded once, all in memory-mapped arrays.

Reading random windows from video costs milliseconds an item; from these arrays it is a memory copy.
The caches stand beside the dataset (`<root>.cache/`), never in it, and are rebuilt when absent. What was
stopped goes on where it was. Depth is brought to the grid of the tokens: metres, 0 where nothing was
measured, one camera's grid after the other.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import torch
from lerobot.configs.video import DepthEncoderConfig
from lerobot.datasets.depth_utils import MM_PER_METRE
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.common.checkpoints import weights_digest
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.hub import cached_repo
from lerobot_wmrl.common.images import from_bytes, stretch
from lerobot_wmrl.data.checks import depth_key
from lerobot_wmrl.data.decoding import decode, decode_depth, row_parts
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.data.resumable_array import WritePlan, batches, memory_map

FAR: Final = 2.5
"""Metres: what is further away counts as that far, as in the recorder's depth maps."""

ROUNDING_METRES: Final = 1e-4
"""Metres by which a depth may differ from the one that stands for no measurement."""


class FrameEncoder(Protocol):
    """Interface of a frame tokenizer, as the caches use it."""

    image_size: int

    @property
    def device(self) -> torch.device:
        """Where its weights are."""

    @property
    def tokens_per_frame(self) -> int:
        """S, tokens of all cameras."""

    def state_dict(self) -> Mapping[str, Tensor]:
        """Return weights and running statistics, which the caches' names depend on."""

    def context(self, images: Tensor) -> Context:
        """Return the context of first frames (B, N, 3, H, W) in [0, 1]."""

    def encode(self, images: Tensor, context: Context = NO_CONTEXT) -> Tensor:
        """Return the tokens (B, S) of frames (B, N, 3, H, W) in [0, 1]."""

    def success_features(self, first: Tensor, images: Tensor) -> Tensor:
        """Return features (B, F) of frames (B, N, 3, H, W) in [0, 1], given their episodes' first frames."""


def cache_dir(dataset: LeRobotDataset) -> Path:
    """Return the folder of a dataset's caches: beside it, or, in the hub's cache, in LeRobot's folder."""
    root = Path(dataset.root).absolute()
    root = root.resolve() if ".." in root.parts else root
    if repo := cached_repo(root):  # which has nothing else there
        return HF_LEROBOT_HOME / "frames" / f"{repo}-{root.name}.cache"
    return root.with_name(root.name + ".cache")


def cached_frames(dataset: LeRobotDataset, camera_keys: Sequence[str], side: int) -> np.ndarray:
    """Return all frames as a read-only memory map, uint8 (rows, N, side, side, 3).

    They are decoded on the first call, and stretched where they are of another size.
    """
    shape = (dataset.num_frames, len(camera_keys), side, side, 3)
    key = digest([dataset.num_episodes, dataset.num_frames, side, *camera_keys, *file_stamps(dataset)])

    def write(target: np.ndarray, episode: int) -> None:
        for rows in row_parts(dataset, episode):
            for camera, name in enumerate(camera_keys):
                frames = stretch(decode(dataset, episode, name, rows), side, side)
                target[rows, camera] = frames.permute(0, 2, 3, 1).numpy()

    plan = WritePlan(dataset.num_episodes, write, "Decoding frames")
    return memory_map(cache_dir(dataset) / f"frames-{key}.npy", shape, np.uint8, plan)


def cached_tokens(dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder) -> np.ndarray:
    """Return all frames' tokens as a read-only memory map, int32 (rows, S); encoded on the first call.

    A context-conditioned tokenizer is given the first frame of each row's episode.
    """
    frames = cached_frames(dataset, camera_keys, tokenizer.image_size)
    device = tokenizer.device
    starts = first_rows(dataset)

    def encode(part: slice) -> np.ndarray:
        first, episode = np.unique(starts[part], return_inverse=True)
        start, images = (frames_to_tensor(frames[rows]).to(device) for rows in (first, part))
        with torch.no_grad():
            context = tokenizer.context(start)[episode]
            return tokenizer.encode(images, context).cpu().numpy()

    shape = (len(frames), tokenizer.tokens_per_frame)
    path = encoded_path("tokens", dataset, camera_keys, tokenizer)
    return memory_map(path, shape, np.int32, batches(len(frames), encode, "Encoding tokens"))


def cached_context(
    dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder
) -> np.ndarray:
    """Return the coarsest features of every episode's context as a read-only memory map.

    float32 (E, N, C, g, g), encoded on the first call.
    """
    frames = cached_frames(dataset, camera_keys, tokenizer.image_size)
    device = tokenizer.device
    starts = np.asarray(dataset.meta.episodes["dataset_from_index"])

    def features(part: slice) -> np.ndarray:
        with torch.no_grad():
            context = tokenizer.context(frames_to_tensor(frames[starts[part]]).to(device))
        return context.features.cpu().numpy()

    shape = (len(starts), *features(slice(0, 1)).shape[1:])
    path = encoded_path("context", dataset, camera_keys, tokenizer)
    return memory_map(path, shape, np.float32, batches(len(starts), features, "Encoding contexts"))


def cached_features(
    dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder
) -> np.ndarray:
    """Return the success classifier's features of all frames as a read-only memory map.

    float32 (rows, F), encoded on the first call.
    """
    frames = cached_frames(dataset, camera_keys, tokenizer.image_size)
    device = tokenizer.device
    starts = first_rows(dataset)

    def features(part: slice) -> np.ndarray:
        first, images = (frames_to_tensor(frames[rows]).to(device) for rows in (starts[part], part))
        with torch.no_grad():
            return tokenizer.success_features(first, images).cpu().numpy()

    shape = (len(frames), *features(slice(0, 1)).shape[1:])
    path = encoded_path("features", dataset, camera_keys, tokenizer)
    return memory_map(path, shape, np.float32, batches(len(frames), features, "Encoding features"))


def first_rows(dataset: LeRobotDataset) -> np.ndarray:
    """Return for each row the first row of its episode. (rows,)"""
    episodes = dataset.meta.episodes
    return np.repeat(np.asarray(episodes["dataset_from_index"]), np.asarray(episodes["length"]))


def encoded_path(
    name: str, dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder
) -> Path:
    """Return the path of the cache `name`, which is valid for these weights, cameras and files alone."""
    key = digest([weights_digest(tokenizer.state_dict()), *camera_keys, *file_stamps(dataset)])
    return cache_dir(dataset) / f"{name}-{key}.npy"


def frames_to_tensor(frames: np.ndarray) -> Tensor:
    """uint8 (B, N, H, W, 3) → float32 (B, N, 3, H, W) in [0, 1]."""
    return from_bytes(torch.from_numpy(np.array(frames)).permute(0, 1, 4, 2, 3))


def file_stamps(dataset: LeRobotDataset) -> list[object]:
    """Return names, sizes and times of the dataset's files, and its fps, by which frames are found in videos:
    a new recording needs caches of its own."""
    root = Path(dataset.root)
    files = sorted(
        path
        for each in ("data", "meta", "videos")
        for path in files_below(root / each)
        if path.suffix in (".mp4", ".parquet")
    )
    stamps = [item for path in files for item in (path.name, path.stat().st_size, path.stat().st_mtime_ns)]
    return [dataset.fps, *stamps]


def files_below(root: Path) -> Iterator[Path]:
    """Yield all files below a folder, behind links too; a folder that links lead back to counts once."""
    known = set[tuple[int, int]]()
    for folder, folders, names in os.walk(root, followlinks=True):
        status = Path(folder).stat()
        if (status.st_dev, status.st_ino) in known:
            folders.clear()
            continue
        known.add((status.st_dev, status.st_ino))
        yield from (Path(folder) / name for name in names)


def digest(parts: Sequence[object]) -> str:
    """Return a short hash of what a cache depends on."""
    return hashlib.sha256(json.dumps([str(part) for part in parts]).encode()).hexdigest()[:12]


def token_depth(metres: Tensor, grid: int) -> Tensor:
    """Average what a camera measured (> 0, finite) in each token's square, 0 where nothing was.

    metres (F, 1, H, W) → (F, g²)
    """
    known = torch.isfinite(metres) & (metres > 0)
    share = F.adaptive_avg_pool2d(known.float(), grid)
    mean = F.adaptive_avg_pool2d(torch.where(known, metres, 0.0), grid)
    return torch.where(share > 0, mean / share, 0.0).flatten(1)


def cached_depth(dataset: LeRobotDataset, camera_keys: Sequence[str], grid: int) -> np.ndarray:
    """Return all frames' depth as a read-only memory map, float32 (rows, S) metres; decoded once."""
    keys = [depth_key(camera) for camera in camera_keys]
    encodings = [dataset.features[name].get("info") for name in keys]
    key = digest([dataset.num_episodes, dataset.num_frames, grid, *keys, *encodings, *file_stamps(dataset)])

    def write(target: np.ndarray, episode: int) -> None:
        for rows in row_parts(dataset, episode):
            cameras = [token_depth(decode_depth(dataset, episode, name, rows), grid) for name in keys]
            target[rows] = torch.cat(cameras, 1).numpy()

    shape = (dataset.num_frames, len(keys) * grid**2)
    episodes = WritePlan(dataset.num_episodes, write, "Decoding depth")
    return memory_map(cache_dir(dataset) / f"depth-{key}.npy", shape, np.float32, episodes)


def unmeasured_depth(features: Mapping[str, Any], camera_keys: Sequence[str]) -> list[float]:
    """Return the metres that LeRobot gives for pixels without a measurement: a video's least depth, or 0."""

    def least(feature: Mapping[str, Any]) -> float:
        if feature["dtype"] != "video":
            return 0.0
        return float(DepthEncoderConfig.from_video_info(feature.get("info") or {}).depth_min)

    return [least(features[depth_key(camera)]) for camera in camera_keys]


def depth_of_windows(
    batch: Mapping[str, Any], camera_keys: Sequence[str], grid: int, unmeasured: Sequence[float]
) -> Tensor:
    """Average depth maps in millimetres, as lerobot-train gives them, to metres a token.

    (B, T, 1, H, W) of each camera → (B, T, S). `unmeasured`: what stands for no measurement, in metres.

    Raises:
        FieldError: the depth of a camera is missing.
    """
    missing = [name for name in map(depth_key, camera_keys) if name not in batch]
    if missing:
        raise FieldError("depth", True, f"the batch lacks {missing}", "use a dataset recorded with depth")
    given = [batch[depth_key(camera)].float() / MM_PER_METRE for camera in camera_keys]
    least = [none + ROUNDING_METRES for none in unmeasured]
    maps = [torch.where(each > at, each, 0.0) for each, at in zip(given, least, strict=True)]
    cameras = [token_depth(each.flatten(0, 1), grid).unflatten(0, each.shape[:2]) for each in maps]
    return torch.cat(cameras, 2)
