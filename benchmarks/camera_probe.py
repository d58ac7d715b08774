"""What can be read from a single frame of a camera: a small network is asked where things are.

    python benchmarks/camera_probe.py --episodes=3200 --cameras front_steep+wrist side_mid+wrist

Frames of planned episodes of all tasks and kinds, in all training scenes, are recorded once and kept.
CNNs are trained on three quarters of the episodes and tested on the others. One, with a spatial soft-argmax,
reads places (errors in mm) and the gripper's opening (in %). Another says whether finger and object touch; it
sees pictures that are shifted and differently lit, which moves places but not contact.
Adds to docs/results/cameras.json.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from tqdm import tqdm, trange

from camera_frames import CANDIDATES, Frames, frames_of
from lerobot_wmrl.files import write_json
from lerobot_wmrl.maniskill.tasks import TASKS
from lerobot_wmrl.precision import compute_in, training_dtype

RESULTS = Path(__file__).parents[1] / "docs" / "results"
NAMES = ("object_x", "object_y", "object_z", "tcp_x", "tcp_y", "tcp_z")
TEST_SHARE = 0.25
BATCH = 64
TOUCHING = 0.002
"""Finger and object touch if the gap between them is smaller (m): a quarter of a pixel at 64 px."""

APART = 0.006
"""From so large a gap on (m) they are clearly apart; in between, one picture can hardly tell."""

GRID = 16
"""Side of the feature maps."""

WIDTHS = {64: (3, 24, 48), 128: (3, 24, 40, 56)}
"""Channels of the strided convolutions, by size of the picture."""

MAPS, POOLED = 32, 24

FASTEST = torch.channels_last
"""Of the formats of pictures, for convolutions in bfloat16 on a CPU."""

SHIFT = 4
"""Pixels that a picture is moved by at most, in training to see contact."""

CONTACT_STEPS = 2
"""Times as many steps as for places."""

AVERAGED = 0.999
"""Of the average of weights that stays from one step to the next."""


class CameraEncoder(nn.Module):
    """(B, 3, H, W) in [0, 1] → where each of the feature maps is strongest, and a coarse picture of them.

    The expected place under a softmax over positions (Levine et al. 2016) reads places below a pixel.
    """

    places: Tensor
    features = 2 * MAPS + POOLED * (GRID // 2) ** 2

    def __init__(self, image_size: int) -> None:
        super().__init__()
        widths = WIDTHS[image_size]
        layers = [
            layer
            for a, b in pairwise(widths)
            for layer in (nn.Conv2d(a, b, 4, stride=2, padding=1), nn.ReLU())
        ]
        self.maps = nn.Sequential(
            *layers, nn.Conv2d(widths[-1], MAPS, 3, padding=1), nn.ReLU(), nn.Conv2d(MAPS, MAPS, 1)
        )
        self.sharpness = nn.Parameter(torch.ones(MAPS, 1))
        self.pool = nn.Sequential(
            nn.ReLU(), nn.Conv2d(MAPS, POOLED, 4, stride=2, padding=1), nn.ReLU(), nn.Flatten()
        )
        centres = (torch.arange(GRID) + 0.5) * 2 / GRID - 1
        self.register_buffer("places", torch.cartesian_prod(centres, centres))

    def forward(self, images: Tensor) -> Tensor:
        maps = self.maps(images - 0.5)
        with compute_in(torch.float32, images.device):
            attention = (maps.float().flatten(2) * self.sharpness).softmax(-1)
            places = attention @ self.places
        return torch.cat([places.flatten(1), self.pool(maps)], 1)


class Probe(nn.Module):
    """An encoder a camera, two layers on all of them. [(B, 3, H, W), …] → (B, outputs)"""

    def __init__(self, image_size: int, cameras: int, outputs: int) -> None:
        super().__init__()
        self.encoders = nn.ModuleList(CameraEncoder(image_size) for _ in range(cameras))
        self.head = nn.Sequential(
            nn.Linear(cameras * CameraEncoder.features, 256), nn.ReLU(), nn.Linear(256, outputs)
        )

    def forward(self, images: list[Tensor]) -> Tensor:
        read = [encoder(image) for encoder, image in zip(self.encoders, images, strict=True)]
        return self.head(torch.cat(read, 1))


def held_out(episode: np.ndarray) -> np.ndarray:
    """Episodes for the test, as many of every task. (N,) bool"""
    return episode // len(TASKS) % round(1 / TEST_SHARE) == 0


@dataclass(frozen=True)
class Pictures:
    """What cameras saw, (N, 3, H, W) uint8 each, and the rows for training and for the test."""

    cameras: list[Tensor]
    train: Tensor
    test: Tensor

    @classmethod
    def of(cls, frames: Frames, cameras: list[str]) -> Self:
        pictures = [torch.from_numpy(frames.images[camera]).permute(0, 3, 1, 2) for camera in cameras]
        test = torch.from_numpy(held_out(frames.episode))
        return cls(pictures, *(mask.nonzero().squeeze(1) for mask in (~test, test)))

    def rows(self, rows: Tensor) -> list[Tensor]:
        """As the networks see them, [(B, 3, H, W), …] in [0, 1]."""
        return [camera[rows].to(torch.float32, memory_format=FASTEST) / 255 for camera in self.cameras]

    def augmented(self, rows: Tensor) -> list[Tensor]:
        """Every camera's pictures shifted by up to `SHIFT` pixels, every picture lit in its own way."""
        return [relit(shifted(picture)) for picture in self.rows(rows)]


def shifted(pictures: Tensor) -> Tensor:
    """(B, 3, H, W), all by the same random number of pixels."""
    height, width = pictures.shape[-2:]
    top, left = torch.randint(2 * SHIFT + 1, (2,)).tolist()
    return F.pad(pictures, (SHIFT,) * 4, mode="replicate")[..., top : top + height, left : left + width]


def relit(pictures: Tensor) -> Tensor:
    """(B, 3, H, W), each with its own contrast and brightness."""
    contrast, brightness = 0.1 * torch.randn(2, len(pictures), 1, 1, 1)
    return (pictures - 0.5) * (1 + contrast) + 0.5 + brightness


def fit(
    outputs: int, pictures: Pictures, look: Callable[[Tensor], list[Tensor]],
    loss: Callable[[Tensor, Tensor], Tensor], steps: int, name: str,
) -> Tensor:  # fmt: skip
    """Train a probe on what `look` gives of rows, by a loss of outputs and rows. → outputs for the test rows

    The test asks the moving average of the weights.
    """
    torch.manual_seed(0)
    model = Probe(pictures.cameras[0].shape[-1], len(pictures.cameras), outputs).to(memory_format=FASTEST)
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(AVERAGED))
    optimizer = torch.optim.AdamW(model.parameters(), 2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, steps)
    dtype = training_dtype("auto", "cpu")
    for _ in trange(steps, desc=f"Probing {name}", unit="step", leave=False):
        batch = pictures.train[torch.randint(len(pictures.train), (BATCH,))]
        with compute_in(dtype, torch.device("cpu")):
            output = model(look(batch))
        optimizer.zero_grad()
        loss(output.float(), batch).backward()
        optimizer.step()
        schedule.step()
        average.update_parameters(model)
    with torch.no_grad():
        return torch.cat([average(pictures.rows(part)) for part in pictures.test.split(256)])


def probe(cameras: list[str], frames: Frames, steps: int) -> dict[str, Any]:
    """Train on three quarters of the episodes, test on the others. → errors by name"""
    pictures = Pictures.of(frames, cameras)
    targets = np.column_stack([frames.places, 100 * frames.opening])
    mean, std = targets[pictures.train].mean(0), targets[pictures.train].std(0)
    scaled = torch.from_numpy((targets - mean) / std).float()
    touches = torch.from_numpy(frames.gap < TOUCHING).float()

    def place_loss(output: Tensor, rows: Tensor) -> Tensor:
        return F.smooth_l1_loss(output, scaled[rows], beta=0.1)

    def contact_loss(output: Tensor, rows: Tensor) -> Tensor:
        return F.binary_cross_entropy_with_logits(output[:, 0], touches[rows])

    contact = fit(1, pictures, pictures.augmented, contact_loss, CONTACT_STEPS * steps, "contact")
    places = fit(targets.shape[1], pictures, pictures.rows, place_loss, steps, "places")
    error = (places - scaled[pictures.test]).abs().numpy() * std
    right = ((contact[:, 0] > 0) == (touches[pictures.test] > 0)).numpy()
    return summary(error, right, frames.gap[pictures.test], frames.episode[pictures.test] % len(TASKS))


def summary(error: np.ndarray, right: np.ndarray, gaps: np.ndarray, task: np.ndarray) -> dict[str, Any]:
    """Mean and median errors (N, 7), the share of right answers to whether there is contact; by task, too."""
    clear = (gaps < TOUCHING) | (gaps > APART)
    means, medians = (
        {name: round(float(value), 1) for name, value in zip(NAMES, values, strict=False)}
        for values in (error.mean(0), np.median(error, 0))
    )
    by_task = {
        name: {
            "object_xy_mm": round(float(error[task == index, :2].mean()), 1),
            "object_xy_median_mm": round(float(np.median(error[task == index, :2])), 1),
            "contact_accuracy": round(float(right[task == index].mean()), 3),
        }
        for index, name in enumerate(TASKS)
    }
    return {
        "mean_mm": means,
        "median_mm": medians,
        "opening_percent": round(float(error[:, -1].mean()), 1),
        "contact_accuracy": round(float(right.mean()), 3),
        "clear_contact_accuracy": round(float(right[clear].mean()), 3),
        "by_task": by_task,
    }


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=800, help="planned episodes to take frames from")
    parser.add_argument("--steps", type=int, default=2500, help="optimiser steps of each probe")
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[64, 128], choices=WIDTHS, help="pixels a side"
    )
    parser.add_argument(
        "--cameras", nargs="+", default=[*CANDIDATES, "wrist"],
        help="what is probed: cameras, or several together, as in front_steep+wrist",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, default=RESULTS / "cameras.json", help="JSON file to add to")
    parser.add_argument(
        "--frames", type=Path, default=Path("outputs/camera_frames"), help="folder that keeps the frames"
    )
    given = parser.parse_args()
    views = sorted({view for cameras in given.cameras for view in cameras.split("+")})
    result = json.loads(given.output.read_text()) if given.output.exists() else {"probes": {}}
    for size in given.sizes:
        frames = frames_of(views, given.episodes, size, given.frames)
        test = int(held_out(frames.episode).sum())
        data = {"frames": len(frames.episode), "test_frames": test, "steps": given.steps}
        for cameras in tqdm(given.cameras, desc=f"{size} px"):
            name = f"{cameras}, {size} px, {given.episodes} episodes"
            result["probes"][name] = {**probe(cameras.split("+"), frames, given.steps), **data}
            write_json(given.output, result)
            print(name, result["probes"][name])


if __name__ == "__main__":
    main()
