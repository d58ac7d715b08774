"""A folder with a page that needs no server: any host of files can show it."""

import json
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from PIL import Image

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import whole_folder, write_text
from lerobot_wmrl.common.statistics import evenly_spaced
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.play.graphs import ExportedWorldModel, export_graphs
from lerobot_wmrl.play.web import PAGES
from lerobot_wmrl.play.world import World

RUNTIME: Final = "onnxruntime-web@1.22.0"
"""What runs the graphs in a browser, as npm names it (MIT licence)."""

RUNTIME_FILES: Final = {
    "ort.wasm.min.js": "ort.wasm.min.mjs",
    "ort-wasm-simd-threaded.js": "ort-wasm-simd-threaded.mjs",
    "ort-wasm-simd-threaded.wasm": "ort-wasm-simd-threaded.wasm",
}
"""Name in the page → in the package. Not every host of files knows that `.mjs` is JavaScript."""

CONTENT_SECURITY_POLICY: Final = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src 'self' data: blob:; "
    "connect-src 'self' data:; worker-src 'self' blob:"
)
"""Where the page may load from (Content-Security-Policy)."""

FETCH_SECONDS: Final = 600
FRAMES_BEYOND: Final = 8
"""Frames after a clip's length in which the exported networks are compared too."""

SPACE: Final = """---
title: Drive a world model
sdk: static
tags: [lerobot, robotics, world-model]
---

A world model of a robot, in your browser. Made by `lerobot-wmrl-play --export`.
"""
"""README.md, by which the hub shows the folder as a static Space."""

PAGE_FILES: Final = ("play.js", "play.css", "local.js")


def export_page(world: World, folder: Path, starts: int) -> str:
    """Write the page; the folder is whole or absent. Return how well the exported networks agree.

    Args:
        world: world with a dataset.
        folder: is new.
        starts: episodes of the dataset, spread evenly, in whose first frames a drive can begin.

    Raises:
        FieldError: the world model cannot be exported, or the runtime cannot be had.
    """
    assert world.table is not None, "the command has asked for a dataset"
    rows = evenly_spaced(len(world.table.start), starts)
    with whole_folder(folder) as partial:
        static, frames = partial / "static", partial / "frames"
        static.mkdir(parents=True)
        frames.mkdir()
        fetch_runtime(static)
        for name in PAGE_FILES:
            shutil.copy2(PAGES / name, static)
        write_text(partial / "index.html", index_page())
        write_text(partial / "README.md", SPACE)
        export_graphs(world.models.model, partial)
        write_frames(world, world.table, rows, frames)
        described = describe(world, world.table, rows)
        write_text(partial / "world.json", json.dumps(described, allow_nan=False))
        longest = rows[world.table.length[rows].argmax()]
        return compare(world, int(longest), partial)


def index_page() -> str:
    """Return the served page, but with the world model in the browser."""
    served = (PAGES / "index.html").read_text()
    guard = f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_SECURITY_POLICY}">'
    return served.replace("<head>", f"<head>\n{guard}").replace("./server.js", "./local.js")


def compare(world: World, row: int, folder: Path) -> str:
    """Imagine a recorded episode with the exported networks and with the world model, beyond a clip.

    Returns:
        How far the pictures and probabilities of success are apart.
    """
    model, exported = world.models.model, ExportedWorldModel(folder, world.model.clip_length)
    drive = world.begin({"episode": row, "frame": 0}, None)
    assert drive.recorded is not None, "it begins in a recorded frame"
    frames = drive.env.newest_frames()
    pictures = drive.recorded.images[:1].transpose(0, 1, 4, 2, 3).astype(np.float32) / 255
    exported.begin(pictures, frames.state.numpy(), drive.instruction)
    colours, chances = [], []
    wanted = world.model.clip_length + FRAMES_BEYOND
    actions = np.resize(drive.recorded.actions, (wanted, drive.recorded.actions.shape[1]))
    for action, imagined in zip(actions, model.imagine(frames, torch.from_numpy(actions)[None]), strict=True):
        outputs = exported.step(action[None])
        shown = model.decode(imagined.tokens, frames.context).images[0].movedim(1, -1).numpy() * 255
        colours.append(np.abs(outputs["pixels"][..., :3] - shown).mean())
        chances.append(np.abs(outputs["done_probability"] - imagined.done_logit.sigmoid().numpy()).max())
    return (
        f"over {len(actions)} frames with recorded actions, its pictures are {np.mean(colours):.2f} of 255 "
        f"away from the world model's on average, its probabilities of success at most {max(chances):.3f}"
    )


def describe(world: World, table: EpisodeTable, rows: np.ndarray) -> dict[str, Any]:
    """Return what the page needs to know of the world model and of these episodes, as JSON."""
    served = world.description()
    return {
        **served,
        "drivers": ["recorded"],
        "policy": "",
        "real": "",
        "goal": False,
        "compares": False,
        "first_frames": True,
        "saves": False,
        "side": world.tokenizer_config.image_size,
        "sizes": [[width, height] for _, height, width in world.tokenizer_config.frame_shapes.values()],
        "window": world.model.clip_length,
        "done_frames": world.config.done_frames,
        "episode_length": world.config.horizon,
        "episodes": [{**served["episodes"][row], **recorded(world, table, row)} for row in rows.tolist()],
    }


def recorded(world: World, table: EpisodeTable, row: int) -> Mapping[str, Any]:
    """Return the state in which an episode begins, and its actions."""
    (rows,) = table.rows([row])
    state = table.state[rows.start, : world.model.state_size]  # of size 0 where the model has none
    return {"state": state.tolist(), "actions": table.action[rows].tolist()}


def write_frames(world: World, table: EpisodeTable, rows: np.ndarray, folder: Path) -> None:
    """Write the first frames of these episodes as the tokenizer sees them, numbered anew."""
    images = cached_frames(
        table.dataset, world.tokenizer_config.camera_keys, world.tokenizer_config.image_size
    )
    for index, row in enumerate(rows.tolist()):
        for camera, image in zip(world.tokenizer_config.cameras, images[int(table.start[row])], strict=True):
            Image.fromarray(image).save(folder / f"{index}_{camera}.png")


def fetch_runtime(folder: Path) -> None:
    """Fetch what runs the graphs in a browser, by npm. FieldError if it cannot be had."""
    with tempfile.TemporaryDirectory() as place:
        command = ["npm", "pack", RUNTIME, "--prefer-offline", "--silent", f"--pack-destination={place}"]
        try:
            subprocess.run(
                command, check=True, capture_output=True, text=True, cwd=place, timeout=FETCH_SECONDS
            )
            with tarfile.open(next(Path(place).glob("*.tgz"))) as package:
                for name, source in RUNTIME_FILES.items():
                    content = package.extractfile(f"package/dist/{source}")
                    assert content is not None, source
                    (folder / name).write_bytes(content.read())
        except (OSError, subprocess.SubprocessError, tarfile.TarError, StopIteration, KeyError) as error:
            reason = getattr(error, "stderr", None) or error
            raise FieldError(
                "export",
                RUNTIME,
                f"npm cannot fetch it ({str(reason).strip()})",
                "install npm, and let it reach a registry",
            ) from error
