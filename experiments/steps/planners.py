"""Success of the planners by task and kind of trajectory, how long they think, and where their episodes go.

    python -m experiments.steps.planners --planner=cartesian --episodes=200 --output_dir=outputs/planners

Episodes take place in random scenes of both splits, without pictures. Writes planners.json and workspace.png:
where the gripper and the object have been, optimal episodes against the others. With --planner=mplib these
are planners_mplib.json and workspace_mplib.png.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from lerobot_dataset_maniskill.planners import MOTIONS, TASK_KINDS, Motion, follow_plan
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.seeds import SELECTION_SEED
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

FIRST_SEED = SELECTION_SEED
"""Neither recorded nor evaluated on."""

Way = np.ndarray


@dataclass(frozen=True)
class Measured:
    """Episodes of one task and kind: successes, positions of TCP and object (N, 2, 3), CPU time of a plan."""

    success: Proportion
    visited: Way
    planning_ms: float

    def as_json(self) -> dict[str, Any]:
        return {**self.success.as_json(), "planning_ms": round(self.planning_ms, 2)}


def play(simulation: Simulation, motion: Motion, kind: str, seed: int) -> tuple[bool, Way, float]:
    """Play one planned episode. → success, positions of TCP and object (T, 2, 3), CPU seconds of its plan"""
    rng = np.random.default_rng(seed)
    scene = SCENES[rng.integers(len(SCENES))]
    simulation.reset(scene, seed)
    start, began = simulation.current_start, time.process_time()
    follower = follow_plan(simulation.task.name, scene, start, kind, rng, motion)
    planning_s, way, succeeded = time.process_time() - began, [], False
    for _ in range(simulation.task.horizon):
        places = simulation.tcp_position, simulation.object_position
        way.append(np.array(places))
        succeeded = simulation.step(follower.act(*places)).success
        if succeeded:
            break
    return succeeded, np.array(way), planning_s


def measure(planner: str, episodes: int) -> dict[str, dict[str, Measured]]:
    """Play the episodes of every task and kind. → results by task and kind"""
    measured: dict[str, dict[str, Measured]] = {}
    motion = MOTIONS[planner]()
    for name, task in TASKS.items():
        simulation = Simulation(task, SCENES, Rendering(()))
        measured[name] = {}
        for kind in TASK_KINDS:
            seeds = range(FIRST_SEED, FIRST_SEED + episodes)
            played = [play(simulation, motion, kind, seed) for seed in tqdm(seeds, desc=f"{name}, {kind}")]
            done, ways, seconds = zip(*played, strict=True)
            success = Proportion(sum(done), episodes)
            measured[name][kind] = Measured(success, np.concatenate(ways), 1e3 * float(np.mean(seconds)))
        simulation.close()
    return measured


def draw(measured: dict[str, dict[str, Measured]], path: Path) -> None:
    """Draw where gripper (blue) and object (orange) were: a row a task, a column a kind, from above."""
    figure = Figure(figsize=(2.2 * len(TASK_KINDS), 2.2 * len(measured)))
    panels = figure.subplots(len(measured), len(TASK_KINDS), sharex=True, sharey=True)
    for row, (task, kinds) in zip(panels, measured.items(), strict=True):
        for axes, (kind, here) in zip(row, kinds.items(), strict=True):
            for which, colour in ((0, "#2b6cb0"), (1, "#dd6b20")):
                x, y = here.visited[:, which, :2].T
                axes.plot(-y, x, ".", color=colour, markersize=0.6, alpha=0.3)
            axes.set_title(f"{task}: {kind.replace('_', ' ')}", fontsize=8)
            axes.set_aspect("equal")
            axes.set_xlim(-0.3, 0.35)
            axes.set_ylim(-0.3, 0.3)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planner", choices=MOTIONS, default="cartesian", help="as of lerobot-wmrl-record")
    parser.add_argument("--episodes", type=int, default=200, help="of each task and kind")
    parser.add_argument("--output_dir", type=Path, required=True, help="where JSON and picture go")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    suffix = "" if given.planner == "cartesian" else f"_{given.planner}"
    measured = measure(given.planner, given.episodes)
    table = {task: {kind: here.as_json() for kind, here in row.items()} for task, row in measured.items()}
    content = {"first_seed": FIRST_SEED, "planner": given.planner, "success": table}
    write_json(given.output_dir / f"planners{suffix}.json", content)
    draw(measured, given.output_dir / f"workspace{suffix}.png")
    for task, row in measured.items():
        print(task, *(f"{kind} {here.success.k}/{here.success.n}" for kind, here in row.items()))


if __name__ == "__main__":
    main()
