"""Frames of other sizes than the world model's."""

from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.images import stretch
from lerobot_wmrl.data.episodes import open_dataset
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor


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
