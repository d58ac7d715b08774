"""Frames of other sizes than the world model's."""

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import stretch
from lerobot_wmrl.data import frame_cache
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.decoding import decode, rows_of
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig, TokenizerConfig
from lerobot_wmrl.world_models.training_data import make_sampler


def test_long_episodes_are_decoded_in_parts_to_the_same_frames(
    small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = ["observation.images.third_view"]
    caches = []
    for part in (frame_cache.DECODED, 7):
        monkeypatch.setattr(frame_cache, "DECODED", part)
        monkeypatch.setattr(frame_cache, "cache_dir", lambda _, part=part: tmp_path / str(part))
        caches.append(np.array(cached_frames(small_dataset, cameras, 32)))
    np.testing.assert_array_equal(*caches)


def test_episodes_that_nobody_reads_are_not_decoded(
    small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tokenizer learns from two chosen episodes; the video of another one may be broken."""

    def decoded(dataset: LeRobotDataset, episode: int, key: str, rows: slice) -> Tensor:
        if episode == 2:
            raise ValueError("cannot be decoded")
        seen.add(episode)
        return decode(dataset, episode, key, rows)

    seen: set[int] = set()
    monkeypatch.setattr(frame_cache, "decode", decoded)
    monkeypatch.setattr(frame_cache, "cache_dir", lambda _: tmp_path)
    tokenizer = TokenizerConfig(cameras=["third_view"], image_size=32)
    model: Any = SimpleNamespace(config=FrameTokenizerConfig(tokenizer=tokenizer, device="cpu"))
    sampler: Any = make_sampler(model, read_episodes(small_dataset), [1, 4], batch_size=64, seed=0)
    assert seen == {1, 4}
    sampler(0)
    assert seen == {1, 4}
    with pytest.raises(ValueError, match="cannot be decoded"):
        make_sampler(model, read_episodes(small_dataset), [2], batch_size=2, seed=0)


def in_table(root: Path, column: str, change: Callable[[float], float]) -> LeRobotDataset:
    """Change a column of the table of episodes, from the second one on."""
    (file,) = root.rglob("meta/episodes/**/*.parquet")
    table = pq.read_table(file)
    first, *others = table[column].to_pylist()
    changed = pa.array([first, *map(change, others)], table.schema.field(column).type)
    pq.write_table(table.set_column(table.schema.get_field_index(column), column, changed), file)
    return LeRobotDataset("local/changed", root=root)


def test_a_table_of_episodes_that_has_them_in_other_rows_is_refused(
    small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    """Pictures of one episode would be paired with actions of another."""
    root = Path(shutil.copytree(small_dataset.root, tmp_path / "dataset"))
    dataset = in_table(root, "dataset_from_index", lambda index: index - 1)
    with pytest.raises(FieldError, match=r"^dataset\.root=.*has them in other rows than the data"):
        frame_cache.episode_starts(dataset)


def test_frames_may_be_shown_a_little_beside_their_time(
    small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    """Up to a quarter of the time between two, where no other frame is as near."""
    key, time = "observation.images.third_view", 1 / small_dataset.fps
    root = Path(shutil.copytree(small_dataset.root, tmp_path / "dataset"))
    dataset = in_table(root, f"videos/{key}/from_timestamp", lambda begin: begin + 0.2 * time)
    rows = rows_of(dataset, 1)
    np.testing.assert_array_equal(decode(dataset, 1, key, rows), decode(small_dataset, 1, key, rows))
    dataset = in_table(root, f"videos/{key}/from_timestamp", lambda begin: begin + 0.1 * time)
    said = (
        f"episode 1: .* no frame at the time of some row from {rows.start} to {rows.stop - 1}, to a quarter"
    )
    with pytest.raises(ValueError, match=said):
        decode(dataset, 1, key, rows)


def test_caches_lie_beside_the_dataset_wherever_a_command_is_called(
    small_dataset: LeRobotDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Path(small_dataset.root)
    monkeypatch.chdir(root)
    for name in (str(root), ".", f"../{root.name}"):
        assert frame_cache.cache_dir(SimpleNamespace(root=name)) == root.with_name(f"{root.name}.cache")


def test_frames_of_any_shape_are_stretched_to_squares_and_back(tmp_path: Path) -> None:
    """A bright left half stays the left half."""
    frame = np.zeros((36, 48, 3), np.uint8)
    frame[:, :24] = 200
    image = {"dtype": "image", "shape": frame.shape, "names": ["height", "width", "channels"]}
    features = {"observation.images.top": image, "action": {"dtype": "float32", "shape": (1,), "names": None}}
    dataset = LeRobotDataset.create("local/wide", 10, features, root=tmp_path / "wide", use_videos=False)
    for _ in range(2):
        row = {"observation.images.top": frame, "action": np.zeros(1, np.float32), "task": "look"}
        dataset.add_frame(row)
    dataset.save_episode()
    dataset.finalize()
    squares = cached_frames(open_dataset(dataset.root), ["observation.images.top"], 16)
    assert squares.shape == (2, 1, 16, 16, 3)
    assert (squares[..., :7, :] == 200).all()
    assert (squares[..., 9:, :] == 0).all()
    wide = stretch(frames_to_tensor(squares)[:, 0], 36, 48)
    assert wide.shape == (2, 3, 36, 48)
    torch.testing.assert_close(wide[:, :, :, :20], torch.full((2, 3, 36, 20), 200 / 255))
