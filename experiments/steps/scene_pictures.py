"""Pictures of every object, every task and every kind of trajectory, for docs/images.

    python -m experiments.steps.scene_pictures --output_dir=outputs/pictures

Writes objects.png, tasks.png and trajectories.png.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lerobot_dataset_maniskill.planners import TASK_KINDS, follow_plan
from lerobot_wmrl.common.frame_strips import in_a_row
from lerobot_wmrl.common.statistics import evenly_spaced
from lerobot_wmrl.maniskill.cameras import CAMERAS, Rendering
from lerobot_wmrl.maniskill.objects import OBJECTS
from lerobot_wmrl.maniskill.scenes import SCENES, Scene
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

IMAGE_SIZE = 160
STRIP_FRAMES = 6
SEED = 4_000_000


def scenes_with_each_object() -> list[Scene]:
    """Return one scene for each object, tables and containers in turn."""
    chosen = []
    for index, name in enumerate(OBJECTS):
        having = [scene for scene in SCENES if scene.object == name]
        chosen.append(having[index % len(having)])
    return chosen


def grid(pictures: Sequence[tuple[str, np.ndarray]], columns: int, path: Path) -> None:
    """Save titled pictures, row by row."""
    rows = -(-len(pictures) // columns)
    height, width = pictures[0][1].shape[:2]
    figure = Figure(figsize=(1.7 * columns * width / height, 1.95 * rows))
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        axes.axis("off")
    for axes, (title, picture) in zip(panels.flat, pictures, strict=False):
        axes.imshow(picture)
        axes.set_title(title, fontsize=8)
    figure.tight_layout(pad=0.4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def episode(simulation: Simulation, scene: Scene, kind: str, seed: int) -> np.ndarray:
    """Return a planned episode in the third view, (T, H, W, 3)."""
    frame, rng = simulation.reset(scene, seed), np.random.default_rng(seed)
    follower = follow_plan(simulation.task.name, scene, simulation.current_start, kind, rng)
    frames = [frame.images["third_view"]]
    for _ in range(simulation.task.horizon):
        frame = simulation.step(follower.act(simulation.tcp_position, simulation.object_position))
        frames.append(frame.images["third_view"])
        if frame.success:
            break
    return np.stack(frames)


def strip(frames: np.ndarray) -> np.ndarray:
    """Return a few evenly spaced frames beside each other."""
    return in_a_row(frames[evenly_spaced(len(frames), STRIP_FRAMES)])


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output_dir", type=Path, required=True, help="where the pictures go")
    return parser


def main() -> None:
    """Entry point."""
    folder = make_parser().parse_args().output_dir
    scenes = scenes_with_each_object()
    simulation = Simulation(TASKS["push"], SCENES, Rendering(CAMERAS, IMAGE_SIZE))
    things = [(s.object, simulation.reset(s, SEED).images["third_view"]) for s in scenes]
    grid([(name.replace("_", " "), picture) for name, picture in things], 7, folder / "objects.png")
    views, strips = [], []
    for task, scene in zip(TASKS.values(), scenes[5:], strict=False):
        simulation.task = task
        frame = simulation.reset(scene, SEED)
        name = task.name.replace("_", " ")
        views += [(f"{name}: {camera.replace('_', ' ')}", frame.images[camera]) for camera in CAMERAS]
        for kind in TASK_KINDS:
            played = episode(simulation, scene, kind, SEED)
            strips.append((f"{name}: {kind.replace('_', ' ')}", strip(played)))
    grid(views, 2 * len(CAMERAS), folder / "tasks.png")
    grid(strips, 2, folder / "trajectories.png")
    simulation.close()


if __name__ == "__main__":
    main()
