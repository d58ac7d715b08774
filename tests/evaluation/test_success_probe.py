from dataclasses import replace

import numpy as np
import torch

from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.data.lazy_rows import LazyRows
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.evaluation.success_probe import labelled_frames, train_probe


def recording_of(dataset) -> Recording:
    return Recording(read_episodes(dataset), cached_frames(dataset, ["observation.images.third_view"], 32))


class Lossless:
    """A tokenizer that keeps every pixel, so that only the probe is tested."""

    num_cameras = 1
    device = torch.device("cpu")

    def context(self, images: torch.Tensor) -> Context:
        return NO_CONTEXT

    def encode(self, images: torch.Tensor, context: Context) -> torch.Tensor:
        return images

    def decode(self, tokens: torch.Tensor, context: Context) -> torch.Tensor:
        return tokens


def test_labels_belong_to_the_frame_an_action_led_to(small_dataset):
    source = recording_of(small_dataset)
    data = labelled_frames(Lossless(), source, np.ones(6, bool), np.random.default_rng(0))
    assert data.success.float().mean() == 0.5
    labels: dict[bytes, set[bool]] = {}
    for row in np.setdiff1d(np.arange(len(source.frames)), source.table.start):
        labels.setdefault(source.frames[row].tobytes(), set()).add(bool(source.table.done[row - 1]))
    for image, success in zip(data.images, data.success, strict=True):
        pixels = torch.nn.functional.interpolate(image, (32, 32), mode="area")
        frame = (pixels * 255).round().byte().permute(0, 2, 3, 1).numpy()
        assert bool(success) in labels[frame.tobytes()]


def test_the_probe_learns_from_chosen_episodes_alone(small_dataset, monkeypatch):
    """Of others, the videos may not be there."""
    source = recording_of(small_dataset)
    read: set[int] = set()
    monkeypatch.setattr(LazyRows, "fill", lambda self, rows: read.update(np.asarray(rows).tolist()))
    chosen = np.arange(6) < 3
    assert train_probe(Lossless(), replace(source, chosen=chosen)) is not None
    assert read
    assert read <= set(source.table.row_numbers(np.flatnonzero(chosen)).tolist())


def test_the_probe_tells_success_in_episodes_it_has_not_seen(make_synthetic_dataset, tmp_path):
    """A square pushed by a tenth of a metre: whether it went so far shows only beside where it began."""
    dataset = make_synthetic_dataset(tmp_path / "dataset", episodes=40)
    probe = train_probe(Lossless(), recording_of(dataset))
    assert probe.held_out_frames > 30
    assert probe.balanced_accuracy > 0.85
