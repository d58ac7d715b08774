"""A small LeRobotDataset made without the simulator: a dot that pushes a square, or goes past it."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import KINDS, TASK_NAMES
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, ACTION_NAMES, FPS, STATE_NAMES

HOLD_FRAMES = 5
SPEED = 0.04
"""Metres a step that the synthetic gripper moves."""

GOAL_SHIFT = 0.1
"""Metres that the object must be pushed along +x."""


def dataset_features(cameras: tuple[str, ...], size: int, depth: bool = False) -> dict[str, dict[str, Any]]:
    """The columns of the dataset contract."""
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    number = {"dtype": "int64", "shape": (1,), "names": None}
    image = {"dtype": "video", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    depth_map = {**image, "shape": (size, size, 1), "info": {"is_depth_map": True}}
    return {
        **{f"observation.images.{camera}": image for camera in cameras},
        **{f"observation.images.{camera}_depth": depth_map for camera in cameras if depth},
        "observation.state": {"dtype": "float32", "shape": (8,), "names": list(STATE_NAMES)},
        "action": {
            "dtype": "float32",
            "shape": (7,),
            "names": list(ACTION_NAMES),
            "info": {"low": list(ACTION_LOW), "high": list(ACTION_HIGH)},
        },
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        **{f"next.{name}": flag for name in ("done", "success", "truncated")},
        **{f"start.{name}": number for name in ("task", "scene", "seed", "kind")},
    }


def draw(gripper: np.ndarray, object_xy: np.ndarray, size: int) -> np.ndarray:
    """A table with a red square (the object) and a blue dot (the gripper). → (H, W, 3) uint8"""
    image = np.full((size, size, 3), (90, 80, 60), np.uint8)
    for (x, y), half, colour in ((object_xy, 3, (220, 30, 30)), (gripper, 2, (30, 30, 230))):
        row, column = int((0.35 - x) / 0.7 * size), int((y + 0.25) / 0.5 * size)
        top, left = max(row - half, 0), max(column - half, 0)
        image[top : max(row + half, 0), left : max(column + half, 0)] = colour
    return image


def measure_depth(image: np.ndarray) -> np.ndarray:
    """Return its depth: the table 1 m away, what stands on it nearer. → (H, W, 1) uint16 millimetres"""
    return np.where(image[..., :1] == 220, 800, np.where(image[..., 2:] == 230, 600, 1000)).astype(np.uint16)


def synthetic_episode(rng: np.random.Generator, fails: bool, length: int) -> list[dict[str, Any]]:
    """A dot pushes a square along +x, or goes past it. One dict a control step, without images."""
    object_xy = rng.uniform((-0.05, -0.1), (0.05, 0.1))
    gripper = object_xy + np.array((-0.12, rng.uniform(-0.05, 0.05)))
    start, held, rows = object_xy.copy(), 0, []
    side = np.array((0.0, 0.1 if fails else 0.0))
    for step in range(length):
        behind = abs(gripper[1] - object_xy[1] - side[1]) < 0.01
        aim = np.array((0.2 if behind else 0.0, object_xy[1] + side[1] - gripper[1]))
        move = np.clip(aim, -SPEED, SPEED).astype(np.float32)
        state = np.array((*gripper, 0.05, 0, 1, 0, 0, 0), np.float32)
        before, gripper = object_xy.copy(), gripper + move
        if abs(gripper[1] - object_xy[1]) < 0.03 and 0 < gripper[0] - object_xy[0] + 0.03 < 0.1:
            object_xy = np.array((gripper[0] + 0.03, object_xy[1]))
        success = bool(object_xy[0] - start[0] >= GOAL_SHIFT)
        held += success
        last = step == length - 1 or held > HOLD_FRAMES
        action = np.array((*move, 0, 0, 0, 0, -1), np.float32)
        rows.append(
            {
                "gripper": state[:2].copy(),
                "object": before,
                "observation.state": state,
                "action": action,
                "next.reward": float(success),
                "next.done": success,
                "next.success": success,
                "next.truncated": last and not success,
            }
        )
        if last:
            break
    return rows


def synthetic_dataset(
    root: Path,
    episodes: int = 6,
    length: int = 20,
    size: int = 32,
    cameras: tuple[str, ...] = ("third_view",),
    instructions: Sequence[str] = ("push the red square forward",),
    depth: bool = False,
) -> LeRobotDataset:
    """A LeRobotDataset at `root` (must not exist) with the contract's columns; every third episode fails.

    Episodes have the instructions in turn.
    """
    dataset = LeRobotDataset.create(
        "local/synthetic", FPS, dataset_features(cameras, size, depth), root=root, robot_type="panda"
    )
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        fails = episode % 3 == 2
        kind = KINDS.index("near_miss" if fails else "optimal")
        task = instructions[episode % len(instructions)]
        start = {"start.task": 0, "start.scene": episode % 2, "start.seed": episode, "start.kind": kind}
        for row in synthetic_episode(rng, fails, length):
            image = draw(row.pop("gripper"), row.pop("object"), size)
            frame = {key: np.array([value]) for key, value in start.items()}
            for key, value in row.items():
                dtype = np.float32 if key == "next.reward" else None
                frame[key] = value if isinstance(value, np.ndarray) else np.array([value], dtype)
            pictures = {f"observation.images.{camera}": image for camera in cameras}
            maps = {f"{key}_depth": measure_depth(image) for key in pictures if depth}
            dataset.add_frame({**frame, **pictures, **maps, "task": task})
        dataset.save_episode()
    dataset.finalize()
    vocabulary = {
        "tasks": TASK_NAMES,
        "kinds": KINDS,
        "scenes": ["synthetic 0", "synthetic 1"],
        "action_low": ACTION_LOW,
        "action_high": ACTION_HIGH,
        "hold_frames": HOLD_FRAMES,
        "image_size": size,
        "cameras": cameras,
    }
    (root / "meta" / "wmrl.json").write_text(json.dumps(vocabulary))
    return LeRobotDataset("local/synthetic", root=root)
