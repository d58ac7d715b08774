"""Frames and depth decoded once, tokens encoded once, when their episodes are first read.

Reading random windows from video costs milliseconds an item; from these arrays it is a memory copy.
The caches stand beside the dataset (`<root>.cache/`), never in it, and are rebuilt when absent. Depth is
brought to the grid of the tokens: metres, 0 where nothing was measured, one camera's grid after the other.
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
from lerobot_wmrl.data.decoding import DECODED, decode, decode_depth
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.data.lazy_rows import LazyRows

ENCODED: Final = 128
"""Frames that are encoded at once."""

FAR: Final = 2.5
"""Metres: what is further away counts as that far, as in the recorder's depth maps."""

NEAREST: Final = 0.05
"""Metres within which the depth of a whole batch is not, unless it is in another unit."""

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


def cached_frames(dataset: LeRobotDataset, camera_keys: Sequence[str], side: int) -> LazyRows:
    """Return all frames, uint8 (rows, N, side, side, 3), stretched where they are of another size."""
    starts = episode_starts(dataset)
    shape = (dataset.num_frames, len(camera_keys), side, side, 3)
    key = digest([dataset.num_episodes, dataset.num_frames, side, *camera_keys, *file_stamps(dataset)])

    def decoded(rows: np.ndarray) -> np.ndarray:
        found = np.empty((len(rows), *shape[1:]), np.uint8)
        for episode, place, part in by_episode(starts, rows):
            for camera, name in enumerate(camera_keys):
                frames = stretch(decode(dataset, episode, name, part), side, side)
                found[place, camera] = frames.permute(0, 2, 3, 1).numpy()
        return found

    path = cache_dir(dataset) / f"frames-{key}.rows"
    return LazyRows(path, shape, np.uint8, starts, decoded, DECODED, "Decoding frames")


def cached_tokens(dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder) -> LazyRows:
    """Return all frames' tokens, int32 (rows, S).

    A context-conditioned tokenizer is given the first frame of each row's episode.
    """
    frames, starts = cached_frames(dataset, camera_keys, tokenizer.image_size), episode_starts(dataset)

    def encoded(rows: np.ndarray) -> np.ndarray:
        first, episode = np.unique(first_rows(starts, rows), return_inverse=True)
        start, images = (frames_to_tensor(frames[each]).to(tokenizer.device) for each in (first, rows))
        with torch.no_grad():
            context = tokenizer.context(start)[episode]
            return tokenizer.encode(images, context).cpu().numpy()

    path = encoded_path("tokens", dataset, camera_keys, tokenizer)
    shape = (len(frames), tokenizer.tokens_per_frame)
    return LazyRows(path, shape, np.int32, starts, encoded, ENCODED, "Encoding tokens")


def cached_context(dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder) -> LazyRows:
    """Return the coarsest features of every episode's context, float32 (E, N, C, g, g)."""
    frames, starts = cached_frames(dataset, camera_keys, tokenizer.image_size), episode_starts(dataset)

    @torch.no_grad()
    def context(images: np.ndarray) -> np.ndarray:
        return tokenizer.context(frames_to_tensor(images).to(tokenizer.device)).features.cpu().numpy()

    path = encoded_path("context", dataset, camera_keys, tokenizer)
    shape = (len(starts), *context(blank(frames)).shape[1:])
    return LazyRows(
        path,
        shape,
        np.float32,
        np.arange(len(starts)),
        lambda rows: context(frames[starts[rows]]),
        ENCODED,
        "Encoding contexts",
    )


def cached_features(dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder) -> LazyRows:
    """Return the success classifier's features of all frames, float32 (rows, F)."""
    frames, starts = cached_frames(dataset, camera_keys, tokenizer.image_size), episode_starts(dataset)

    @torch.no_grad()
    def features(*pair: np.ndarray) -> np.ndarray:
        first, images = (frames_to_tensor(each).to(tokenizer.device) for each in pair)
        return tokenizer.success_features(first, images).cpu().numpy()

    path = encoded_path("features", dataset, camera_keys, tokenizer)
    shape = (len(frames), *features(blank(frames), blank(frames)).shape[1:])
    return LazyRows(
        path,
        shape,
        np.float32,
        starts,
        lambda rows: features(frames[first_rows(starts, rows)], frames[rows]),
        ENCODED,
        "Encoding features",
    )


def episode_starts(dataset: LeRobotDataset) -> np.ndarray:
    """Return each episode's first row. (E,)

    Raises:
        FieldError: the table of episodes, by which pictures are found, says otherwise than the rows.
    """
    table = np.asarray(dataset.meta.episodes["dataset_from_index"][:])  # slow row by row
    rows = dataset.hf_dataset.with_format("numpy", columns=["episode_index"])[:]["episode_index"]
    starts: np.ndarray = np.unique(rows, return_index=True)[1]
    if not np.array_equal(table, starts):
        raise FieldError(
            "dataset.root",
            dataset.root,
            "its table of episodes (meta/episodes) has them in other rows than the data",
            "copy or download it again, or write it anew with lerobot-edit-dataset",
        )
    return starts


def first_rows(starts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return for each row the first row of its episode. (K,)"""
    found: np.ndarray = starts[np.searchsorted(starts, rows, side="right") - 1]
    return found


def by_episode(starts: np.ndarray, rows: np.ndarray) -> Iterator[tuple[int, slice, slice]]:
    """Divide ascending rows (K,), which follow each other in every episode: yield the episode, where its rows
    are among them, and these rows."""
    episodes, places = np.unique(np.searchsorted(starts, rows, side="right") - 1, return_index=True)
    for episode, begin, end in zip(episodes.tolist(), places, [*places[1:], len(rows)], strict=True):
        yield episode, slice(begin, end), slice(int(rows[begin]), int(rows[end - 1]) + 1)


def blank(frames: LazyRows) -> np.ndarray:
    """Return one row of black frames, by which the shape of what is made of frames is found."""
    return np.zeros((1, *frames.shape[1:]), np.uint8)


def encoded_path(
    name: str, dataset: LeRobotDataset, camera_keys: Sequence[str], tokenizer: FrameEncoder
) -> Path:
    """Return the path of the cache `name`, which is valid for these weights, cameras and files alone."""
    key = digest([weights_digest(tokenizer.state_dict()), *camera_keys, *file_stamps(dataset)])
    return cache_dir(dataset) / f"{name}-{key}.rows"


def frames_to_tensor(frames: np.ndarray) -> Tensor:
    """uint8 (B, N, H, W, 3) → float32 (B, N, 3, H, W) in [0, 1]."""
    return from_bytes(torch.from_numpy(np.array(frames)).permute(0, 1, 4, 2, 3))


def file_stamps(dataset: LeRobotDataset) -> list[object]:
    """Return names, sizes and times of the dataset's files, and its fps, by which frames are found in videos:
    a new recording needs caches of its own.

    In the hub's cache the commit, which names the folder, stands for the videos: more of them may arrive.
    """
    root = Path(dataset.root)
    cached = cached_repo(root.absolute()) is not None
    files = sorted(
        path
        for each in ("data", "meta", *(() if cached else ("videos",)))
        for path in files_below(root / each)
        if path.suffix in (".mp4", ".parquet")
    )
    stamps = [item for path in files for item in (path.name, path.stat().st_size, path.stat().st_mtime_ns)]
    return [dataset.fps, *([root.name] if cached else []), *stamps]


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


def cached_depth(dataset: LeRobotDataset, camera_keys: Sequence[str], grid: int) -> LazyRows:
    """Return all frames' depth, float32 (rows, S) metres."""
    keys = [depth_key(camera) for camera in camera_keys]
    encodings = [dataset.features[name].get("info") for name in keys]
    key = digest([dataset.num_episodes, dataset.num_frames, grid, *keys, *encodings, *file_stamps(dataset)])

    def decoded(rows: np.ndarray) -> np.ndarray:
        found = []
        for episode, _, part in by_episode(starts, rows):
            cameras = [token_depth(decode_depth(dataset, episode, name, part), grid) for name in keys]
            found.append(torch.cat(cameras, 1).numpy())
        return np.concatenate(found)

    starts, shape = episode_starts(dataset), (dataset.num_frames, len(keys) * grid**2)
    path = cache_dir(dataset) / f"depth-{key}.rows"
    return LazyRows(path, shape, np.float32, starts, decoded, DECODED, "Decoding depth")


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
        FieldError: the depth of a camera is missing, or is in metres.
    """
    missing = [name for name in map(depth_key, camera_keys) if name not in batch]
    if missing:
        raise FieldError("depth", True, f"the batch lacks {missing}", "use a dataset recorded with depth")
    given = [batch[depth_key(camera)].float() / MM_PER_METRE for camera in camera_keys]
    farthest = max(each.max().item() for each in given)
    if 0 < farthest < NEAREST:
        raise FieldError(
            "dataset.depth_output_unit",
            "m",
            f"no depth of this batch is above {MM_PER_METRE * farthest:.3g} mm, so it is in metres",
            "leave it out: world models read millimetres",
        )
    least = [none + ROUNDING_METRES for none in unmeasured]
    maps = [torch.where(each > at, each, 0.0) for each, at in zip(given, least, strict=True)]
    cameras = [token_depth(each.flatten(0, 1), grid).unflatten(0, each.shape[:2]) for each in maps]
    return torch.cat(cameras, 2)
