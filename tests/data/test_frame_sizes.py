"""Frames of other sizes than the world model's."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import stretch
from lerobot_wmrl.data import decoding, frame_cache
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor


def test_long_episodes_are_decoded_in_parts_to_the_same_frames(
    small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = ["observation.images.third_view"]
    caches = []
    for part in (decoding.DECODED, 7):
        monkeypatch.setattr(decoding, "DECODED", part)
        monkeypatch.setattr(frame_cache, "cache_dir", lambda _, part=part: tmp_path / str(part))
        caches.append(cached_frames(small_dataset, cameras, 32))
    np.testing.assert_array_equal(*caches)


def test_a_disk_that_is_full_says_so_and_leaves_nothing(
    small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    monkeypatch.setattr(frame_cache, "cache_dir", lambda _: tmp_path / "cache")
    with pytest.raises(FieldError, match=r"which cannot be written .*No space left"):
        cached_frames(small_dataset, ["observation.images.third_view"], 32)
    assert not list((tmp_path / "cache").iterdir())


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
