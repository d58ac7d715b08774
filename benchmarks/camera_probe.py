"""What can be read from a single frame of a camera: a small network is asked where things are.

    python benchmarks/camera_probe.py --episodes=480

Frames of planned episodes of all tasks and kinds, in all training scenes. A CNN is trained on some episodes
and tested on others; the errors are means of absolute values in mm, and whether finger and object touch.
Writes docs/results/cameras.json.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm, trange

from lerobot_dataset_maniskill.planners import TASK_KINDS, follow_plan
from lerobot_wmrl.files import write_json
from lerobot_wmrl.maniskill.cameras import VIEWS, View
from lerobot_wmrl.maniskill.processes import simulating_context
from lerobot_wmrl.maniskill.rendering import Rendering
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

RESULTS = Path(__file__).parents[1] / "docs" / "results"
CANDIDATES = {
    "front_steep": View((0.52, 0.0, 0.60), (0.0, -0.035, 0.035), 0.53),
    "front_mid": View((0.62, 0.0, 0.40), (0.0, -0.035, 0.05), 0.55),
    "corner": View((0.45, 0.35, 0.45), (-0.1, 0.0, 0.05), 1.0),
    "corner_near": View((0.42, 0.34, 0.42), (0.0, -0.03, 0.04), 0.62),
    "side_mid": View((0.0, 0.55, 0.42), (0.0, -0.035, 0.04), 0.6),
    "side_low": View((-0.02, 0.62, 0.28), (0.0, -0.03, 0.05), 0.6),
}
FIRST_SEED = 3_000_000
NAMES = ("object_x", "object_y", "object_z", "tcp_x", "tcp_y", "tcp_z")
EVERY = 5
"""Steps between two frames."""

PROCESSES = 2
TEST_SHARE = 0.25
TOUCHING = 0.002
"""Finger and object touch if the gap between them is smaller (m): a quarter of a pixel at 64 px."""

APART = 0.006
"""From so large a gap on (m) they are clearly apart; in between, one picture can hardly tell."""


class Frames(NamedTuple):
    """images {view: (N, H, W, 3) uint8}; places (N, 6) in mm; opening (N,); gap (N,) in m; episode (N,)."""

    images: dict[str, np.ndarray]
    places: np.ndarray
    opening: np.ndarray
    gap: np.ndarray
    episode: np.ndarray


def gap(simulation: Simulation) -> float:
    """Between the object and the nearest finger (m); infinite where physics sees no contact coming."""
    thing = simulation.env.active._objs[0]
    contacts = simulation.env.scene.sub_scenes[0].physx_system.get_contacts()
    gaps = [point.separation for contact in contacts if _meet(contact, thing) for point in contact.points]
    return float(min(gaps, default=np.inf))


def _meet(contact: Any, thing: Any) -> bool:
    """Whether the contact is one of a finger and the object."""
    entities = [body.entity for body in contact.bodies]
    return thing in entities and any("finger" in entity.name for entity in entities)


def record(views: list[str], episodes: int, sizes: list[int]) -> dict[int, Frames]:
    """Every fifth frame of `episodes` planned episodes, at every size. → {size: frames}"""
    with ProcessPoolExecutor(PROCESSES, simulating_context()) as pool:
        shares = [
            (views, range(first, episodes, PROCESSES), size) for size in sizes for first in range(PROCESSES)
        ]
        parts = list(
            tqdm(pool.map(record_share, *zip(*shares, strict=True)), total=len(shares), desc="Recording")
        )
    return {size: joined(parts[PROCESSES * i : PROCESSES * (i + 1)]) for i, size in enumerate(sizes)}


def joined(parts: list[Frames]) -> Frames:
    """The frames of several processes as one."""
    images = {view: np.concatenate([part.images[view] for part in parts]) for view in parts[0].images}
    return Frames(images, *(np.concatenate(columns) for columns in list(zip(*parts, strict=True))[1:]))


def record_share(views: list[str], episodes: range, image_size: int) -> Frames:
    """In a process of its own: some of the episodes, at one size."""
    scenes, tasks = scenes_of("ind"), list(TASKS.values())
    VIEWS.update(CANDIDATES)
    simulation = Simulation(tasks[0], scenes, Rendering(tuple(views), image_size))
    every = simulation.cameras
    images: dict[str, list[np.ndarray]] = {view: [] for view in views}
    rows: list[tuple[list[float], float, float, int]] = []
    for episode in episodes:
        rng = np.random.default_rng(FIRST_SEED + episode)
        simulation.task = tasks[episode % len(tasks)]
        scene, kind = scenes[rng.integers(len(scenes))], TASK_KINDS[rng.integers(len(TASK_KINDS))]
        frame = simulation.reset(scene, FIRST_SEED + episode)
        follower = follow_plan(simulation.task.name, scene, simulation.current_start, kind, rng)
        for step in range(simulation.task.horizon):
            places = simulation.tcp_position, simulation.object_position
            if step % EVERY == 0:
                for view in views:
                    images[view].append(frame.images[view])
                millimetres = [1000 * float(value) for value in (*places[1], *places[0])]
                rows.append((millimetres, simulation.gripper_opening, gap(simulation), episode))
            simulation.cameras = every if (step + 1) % EVERY == 0 else {}
            frame = simulation.step(follower.act(*places))
            if frame.success:
                break
        simulation.cameras = every
    simulation.close()
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Frames({view: np.stack(kept) for view, kept in images.items()}, *columns)


class Probe(nn.Module):
    """A CNN that keeps where things are: strided convolutions to a grid of 8x8 features, two layers on it."""

    def __init__(self, image_size: int, outputs: int) -> None:
        super().__init__()
        widths = (3, 24, 48, 64) if image_size <= 64 else (3, 16, 32, 48, 64)
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 4, stride=2, padding=1) for a, b in pairwise(widths))
        self.head = nn.Sequential(nn.LazyLinear(256), nn.ReLU(), nn.Linear(256, outputs))

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] → (B, outputs). Two pictures side by side share the convolutions."""
        x = images - 0.5
        for layer in self.layers:
            x = F.relu(layer(x))
        return self.head(x.flatten(1))


def held_out(episode: np.ndarray) -> np.ndarray:
    """Episodes for the test, as many of every task. (N,) bool"""
    return episode // len(TASKS) % round(1 / TEST_SHARE) == 0


def probe(images: np.ndarray, frames: Frames, steps: int) -> dict[str, Any]:
    """Train on three quarters of the episodes, test on the others. → errors by name"""
    torch.manual_seed(0)
    pictures = torch.from_numpy(images).permute(0, 3, 1, 2)
    targets = np.column_stack([frames.places, 100 * frames.opening])
    train = ~held_out(frames.episode)
    mean, std = targets[train].mean(0), targets[train].std(0)
    scaled = torch.from_numpy((targets - mean) / std).float()
    contact = torch.from_numpy(frames.gap < TOUCHING).float()
    model = Probe(images.shape[1], targets.shape[1] + 1)
    model(pictures[:1].float() / 255)
    optimizer = torch.optim.AdamW(model.parameters(), 2e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, steps)
    rows = torch.from_numpy(train.nonzero()[0])
    for _ in trange(steps, desc="Probing", unit="step", leave=False):
        batch = rows[torch.randint(len(rows), (64,))]
        output = model(pictures[batch].float() / 255)
        loss = F.smooth_l1_loss(output[:, :-1], scaled[batch], beta=0.1)
        loss = loss + 0.3 * F.binary_cross_entropy_with_logits(output[:, -1], contact[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        output = torch.cat([model(part.float() / 255) for part in pictures[~train].split(256)])
    error = (output[:, :-1] - scaled[~train]).abs().numpy() * std
    right = ((output[:, -1] > 0) == (contact[~train] > 0)).numpy()
    return summary(error, right, frames.gap[~train], frames.episode[~train] % len(TASKS))


def summary(error: np.ndarray, right: np.ndarray, gaps: np.ndarray, task: np.ndarray) -> dict[str, Any]:
    """Mean errors (N, 7), the share of right answers to whether there is contact, and both by task."""
    clear = (gaps < TOUCHING) | (gaps > APART)
    means = {f"{name}_mm": float(value) for name, value in zip(NAMES, error.mean(0), strict=False)}
    by_task = {
        name: {
            "object_xy_mm": round(float(error[task == index, :2].mean()), 1),
            "contact_accuracy": round(float(right[task == index].mean()), 3),
        }
        for index, name in enumerate(TASKS)
    }
    return {
        **{name: round(value, 1) for name, value in means.items()},
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
    parser.add_argument("--episodes", type=int, default=480, help="planned episodes to take frames from")
    parser.add_argument("--steps", type=int, default=2500, help="optimiser steps of each probe")
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128], help="pixels a side")
    parser.add_argument(
        "--cameras", nargs="+", default=[*CANDIDATES, "wrist"],
        help="what is probed: cameras, or several together, as in front_steep+wrist",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, default=RESULTS / "cameras.json", help="JSON file to add to")
    given = parser.parse_args()
    views = sorted({view for cameras in given.cameras for view in cameras.split("+")})
    result = json.loads(given.output.read_text()) if given.output.exists() else {"probes": {}}
    for size, frames in record(views, given.episodes, given.sizes).items():
        test = int(held_out(frames.episode).sum())
        data = {"frames": len(frames.episode), "test_frames": test, "steps": given.steps}
        for cameras in tqdm(given.cameras, desc=f"{size} px"):
            images = np.concatenate([frames.images[view] for view in cameras.split("+")], axis=2)
            name = f"{cameras}, {size} px, {given.episodes} episodes"
            result["probes"][name] = {**probe(images, frames, given.steps), **data}
            write_json(given.output, result)
    for name, errors in result["probes"].items():
        print(name, errors)


if __name__ == "__main__":
    main()
