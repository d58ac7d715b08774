"""Frames for the camera probe: planned episodes of all tasks and kinds, in all training scenes."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from tqdm import tqdm

from lerobot_dataset_maniskill.planners import TASK_KINDS, follow_plan
from lerobot_wmrl.common.seeds import GATE_SEED
from lerobot_wmrl.maniskill.backend import simulating_context
from lerobot_wmrl.maniskill.cameras import VIEWS, Rendering, View
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

CANDIDATES = {
    "front_steep": View((0.52, 0.0, 0.60), (0.0, -0.035, 0.035), 0.53),
    "front_mid": View((0.62, 0.0, 0.40), (0.0, -0.035, 0.05), 0.55),
    "corner": View((0.45, 0.35, 0.45), (-0.1, 0.0, 0.05), 1.0),
    "corner_near": View((0.42, 0.34, 0.42), (0.0, -0.03, 0.04), 0.62),
    "side_mid": View((0.0, 0.55, 0.42), (0.0, -0.035, 0.04), 0.6),
    "side_low": View((-0.02, 0.62, 0.28), (0.0, -0.03, 0.05), 0.6),
}
FIRST_SEED = GATE_SEED
"""Neither recorded nor evaluated on."""
EVERY = 5
"""Steps between two frames."""

PROCESSES = 2
PART = 100
"""Episodes that are recorded, and kept, together."""


class Frames(NamedTuple):
    """images {view: (N, H, W, 3) uint8}; places (N, 6) in mm; opening (N,); gap (N,) in m; episode (N,)."""

    images: dict[str, np.ndarray]
    places: np.ndarray
    opening: np.ndarray
    gap: np.ndarray
    episode: np.ndarray

    def save(self, path: Path) -> None:
        """Write the frames; a crash never leaves half a file."""
        partial = path.with_suffix(".partial.npz")
        arrays: dict[str, Any] = {**self.images, **{name: getattr(self, name) for name in self._fields[1:]}}
        np.savez(partial, **arrays)
        partial.replace(path)

    @classmethod
    def load(cls, path: Path, views: list[str]) -> Self:
        with np.load(path) as kept:
            return cls({view: kept[view] for view in views}, *(kept[name] for name in cls._fields[1:]))


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


def frames_of(views: list[str], episodes: int, size: int, folder: Path) -> Frames:
    """Every fifth frame of the first `episodes` planned episodes, rounded up to whole parts.

    A part that `folder` holds is not recorded again.
    """
    starts = range(0, episodes, PART)
    paths = [folder / f"{'+'.join(views)}-{size}-{start}.npz" for start in starts]
    missing = [
        (views, start, size, path) for start, path in zip(starts, paths, strict=True) if not path.exists()
    ]
    if missing:
        folder.mkdir(parents=True, exist_ok=True)
        with ProcessPoolExecutor(PROCESSES, simulating_context()) as pool:
            list(
                tqdm(pool.map(record_part, *zip(*missing, strict=True)), total=len(missing), desc="Recording")
            )
    parts = [Frames.load(path, views) for path in paths]
    images = {view: np.concatenate([part.images[view] for part in parts]) for view in views}
    return Frames(images, *(np.concatenate(columns) for columns in list(zip(*parts, strict=True))[1:]))


def record_part(views: list[str], first: int, image_size: int, path: Path) -> None:
    """Render `PART` episodes at one size, in a process of its own."""
    scenes, tasks = scenes_of("ind"), list(TASKS.values())
    VIEWS.update(CANDIDATES)
    simulation = Simulation(tasks[0], scenes, Rendering(tuple(views), image_size))
    every = simulation.cameras
    images: dict[str, list[np.ndarray]] = {view: [] for view in views}
    rows: list[tuple[list[float], float, float, int]] = []
    for episode in range(first, first + PART):
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
    Frames({view: np.stack(kept) for view, kept in images.items()}, *columns).save(path)
