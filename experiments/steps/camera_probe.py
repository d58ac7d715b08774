"""What can be read from a single frame of a camera: a small network is asked where things are.

    python -m experiments.steps.camera_probe --cameras front_steep+wrist --output=outputs/cameras.json

Frames of planned episodes of all tasks and kinds, in all training scenes, are recorded once and kept.
A CNN with a spatial soft-argmax is trained on three quarters of the episodes and tested on the others:
errors of places in mm, of the gripper's opening in %, and whether finger and object touch.
Adds to the JSON file that is given.
"""

import argparse
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm, trange

from experiments.steps.camera_frames import CANDIDATES, Frames, frames_of
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.images import from_bytes
from lerobot_wmrl.maniskill.tasks import TASKS

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
        attention = (maps.flatten(2) * self.sharpness).softmax(-1)
        return torch.cat([(attention @ self.places).flatten(1), self.pool(maps)], 1)


class Probe(nn.Module):
    """One encoder for each camera, two layers on all of them. [(B, 3, H, W), …] → (B, outputs)"""

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
    """Return which frames are held out for the test, as many of every task. (N,) → (N,) bool"""
    return episode // len(TASKS) % round(1 / TEST_SHARE) == 0


def probe(cameras: list[str], frames: Frames, steps: int) -> dict[str, Any]:
    """Train on three quarters of the episodes, test on the others. → errors by name"""
    torch.manual_seed(0)
    pictures = [torch.from_numpy(frames.images[camera]).permute(0, 3, 1, 2) for camera in cameras]
    targets = np.column_stack([frames.places, 100 * frames.opening])
    train = ~held_out(frames.episode)
    mean, std = targets[train].mean(0), targets[train].std(0)
    scaled = torch.from_numpy((targets - mean) / std).float()
    contact = torch.from_numpy(frames.gap < TOUCHING).float()
    model = Probe(pictures[0].shape[-1], len(cameras), targets.shape[1] + 1)
    optimizer = torch.optim.AdamW(model.parameters(), 2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, steps)

    def read(rows: Tensor) -> Tensor:
        return model([from_bytes(picture[rows]) for picture in pictures])

    train_rows, test_rows = (torch.from_numpy(mask.nonzero()[0]) for mask in (train, ~train))
    for _ in trange(steps, desc="Probing", unit="step", leave=False):
        batch = train_rows[torch.randint(len(train_rows), (BATCH,))]
        output = read(batch)
        loss = F.smooth_l1_loss(output[:, :-1], scaled[batch], beta=0.1)
        loss = loss + 0.3 * F.binary_cross_entropy_with_logits(output[:, -1], contact[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        output = torch.cat([read(part) for part in test_rows.split(256)])
    error = (output[:, :-1] - scaled[test_rows]).abs().numpy() * std
    right = ((output[:, -1] > 0) == (contact[test_rows] > 0)).numpy()
    return summary(error, right, frames.gap[~train], frames.episode[~train] % len(TASKS))


def summary(error: np.ndarray, right: np.ndarray, gaps: np.ndarray, task: np.ndarray) -> dict[str, Any]:
    """Return mean and median of errors (N, 7) and the accuracy of contact, also by task."""
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


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=800, help="planned episodes to take frames from")
    parser.add_argument("--steps", type=int, default=2500, help="optimizer steps of each probe")
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[64, 128], choices=WIDTHS, help="pixels a side"
    )
    parser.add_argument(
        "--cameras",
        nargs="+",
        default=[*CANDIDATES, "wrist"],
        help="what is probed: cameras, or several together, as in front_steep+wrist",
    )
    parser.add_argument("--output", type=Path, required=True, help="JSON file to add to")
    parser.add_argument(
        "--frames", type=Path, default=Path("outputs/camera_frames"), help="folder that keeps the frames"
    )
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
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
