"""Success of the planners by task and kind of trajectory, and where their episodes go.

    python benchmarks/planner_success.py --episodes=200

Episodes take place in random scenes of both splits, without pictures. Writes docs/results/planners.json, and
docs/images/workspace.png: where the gripper and the object have been, optimal episodes against the others.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from lerobot_dataset_maniskill.planners import TASK_KINDS, follow_plan
from lerobot_wmrl.files import write_json
from lerobot_wmrl.maniskill.rendering import Rendering
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS
from lerobot_wmrl.statistics import Proportion

DOCS = Path(__file__).parents[1] / "docs"
FIRST_SEED = 2_000_000
"""Neither recorded nor evaluated on."""

Way = np.ndarray


def play(simulation: Simulation, kind: str, seed: int) -> tuple[bool, Way]:
    """One planned episode: its success, and the way of TCP and object (T, 2, 3)."""
    rng = np.random.default_rng(seed)
    scene = SCENES[rng.integers(len(SCENES))]
    simulation.reset(scene, seed)
    start = simulation.current_start
    follower, way, succeeded = follow_plan(simulation.task.name, scene, start, kind, rng), [], False
    for _ in range(simulation.task.horizon):
        places = simulation.tcp_position, simulation.object_position
        way.append(np.array(places))
        succeeded = simulation.step(follower.act(*places)).success
        if succeeded:
            break
    return succeeded, np.array(way)


def measure(episodes: int) -> tuple[dict[str, dict[str, Proportion]], dict[str, dict[str, Way]]]:
    """Success by task and kind, and all positions, each (N, 2, 3)."""
    success: dict[str, dict[str, Proportion]] = {}
    visited: dict[str, dict[str, Way]] = {}
    for name, task in TASKS.items():
        simulation = Simulation(task, SCENES, Rendering(()))
        success[name], visited[name] = {}, {}
        for kind in TASK_KINDS:
            seeds = range(FIRST_SEED, FIRST_SEED + episodes)
            played = [play(simulation, kind, seed) for seed in tqdm(seeds, desc=f"{name}, {kind}")]
            success[name][kind] = Proportion(sum(done for done, _ in played), episodes)
            visited[name][kind] = np.concatenate([way for _, way in played])
        simulation.close()
    return success, visited


def draw(visited: dict[str, dict[str, Way]], path: Path) -> None:
    """Seen from above: a row a task, a column a kind; blue the gripper, orange the object."""
    figure = Figure(figsize=(2.2 * len(TASK_KINDS), 2.2 * len(visited)))
    panels = figure.subplots(len(visited), len(TASK_KINDS), sharex=True, sharey=True)
    for row, (task, kinds) in zip(panels, visited.items(), strict=True):
        for axes, (kind, places) in zip(row, kinds.items(), strict=True):
            for which, colour in ((0, "#2b6cb0"), (1, "#dd6b20")):
                x, y = places[:, which, :2].T
                axes.plot(-y, x, ".", color=colour, markersize=0.6, alpha=0.3)
            axes.set_title(f"{task}: {kind.replace('_', ' ')}", fontsize=8)
            axes.set_aspect("equal")
            axes.set_xlim(-0.3, 0.35)
            axes.set_ylim(-0.3, 0.3)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=200, help="of each task and kind")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of results and images")
    given = parser.parse_args(arguments)
    success, visited = measure(given.episodes)
    table = {task: {kind: rate.as_json() for kind, rate in row.items()} for task, row in success.items()}
    write_json(given.docs / "results" / "planners.json", {"first_seed": FIRST_SEED, "success": table})
    draw(visited, given.docs / "images" / "workspace.png")
    for task, row in success.items():
        print(task, *(f"{kind} {rate.k}/{rate.n}" for kind, rate in row.items()))


if __name__ == "__main__":
    main()
