"""How exactly must one know where the object is, to judge a rollout from its first frame and its actions?

    python -m experiments.steps.gate_sensitivity --dataset.root=outputs/rollouts --output=outputs/s.json

The gate replays real actions open loop. Here the simulator itself is asked in the world model's place: each
recorded episode is repeated with its own actions, but the object stands a little off, by a normal error
along x and y. The share of failures that then succeed, and of successes that still do, is what a perfect
model of physics would get at the gate, were its eyes so good. With an error of 0 it is how exactly the
simulator repeats itself.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from tqdm import tqdm

from lerobot_wmrl.common.constants import START_COLUMNS, START_SCENE, START_TASK, TASK_NAMES
from lerobot_wmrl.common.files import markdown_table, write_json
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import task_of

ERRORS_MM: Final = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0)


def put_aside(simulation: Simulation, shift: np.ndarray) -> None:
    """Displace the object by `shift` (2,), in metres, at the start of the episode."""
    episode = simulation.episode
    episode.start = replace(episode.start, object_xy=episode.start.object_xy + shift)
    simulation.env.place(episode.scene, episode.start)
    episode.begin(simulation.object_position)


def succeeds(simulation: Simulation, actions: np.ndarray) -> bool:
    """Return whether success holds after one of the actions (T, 7)."""
    return any(simulation.step(action).success for action in actions)


def repeated(simulation: Simulation, table: EpisodeTable, errors_mm: Sequence[float]) -> np.ndarray:
    """Return the success of every episode with each error. → (E, errors)"""
    success = np.zeros((len(table.start), len(errors_mm)), bool)
    for episode in tqdm(range(len(table.start)), desc="Repeating episodes", unit="episode"):
        task, scene, seed, _ = (int(table.columns[name][episode]) for name in START_COLUMNS)
        (rows,) = table.rows([episode])
        actions = table.action[rows]
        direction = np.random.default_rng(seed).normal(size=2)
        simulation.task = task_of(TASK_NAMES[task])
        for column, error in enumerate(errors_mm):
            simulation.reset(SCENES[scene], seed)
            put_aside(simulation, error / 1000 * direction)
            success[episode, column] = succeeds(simulation, actions)
    return success


def measure(repeats: np.ndarray, success: np.ndarray, errors_mm: Sequence[float]) -> list[dict[str, Any]]:
    """Return the gate at each error; repeats (E, errors) succeed or not, success (E,) is the recorded one."""
    return [
        {
            "error_mm": error,
            "false_positive_rate": Proportion.of(calls[~success]).as_json(),
            "recall": Proportion.of(calls[success]).as_json(),
        }
        for error, calls in zip(errors_mm, repeats.T, strict=True)
    ]


def results_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table with a line for each error."""
    lines = []
    for row in rows:
        rates = (row[name] for name in ("false_positive_rate", "recall"))
        lines.append([row["error_mm"], *(str(Proportion.from_json(rate)) for rate in rates)])
    return markdown_table(["error (mm)", "false positives", "recall"], lines)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset.root", dest="root", required=True, help="recorded rollouts")
    parser.add_argument("--errors", type=float, nargs="+", default=list(ERRORS_MM), help="in millimetres")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main() -> None:
    """Entry point."""
    register_third_party_plugins()
    given = make_parser().parse_args()
    table = read_episodes(open_dataset(given.root))
    scenes = [SCENES[scene] for scene in np.unique(table.columns[START_SCENE])]
    task = task_of(TASK_NAMES[int(table.columns[START_TASK][0])])
    simulation = Simulation(task, scenes, Rendering(cameras=()))
    rows = measure(repeated(simulation, table, given.errors), table.success, given.errors)
    write_json(given.output, {"episodes": len(table.start), "errors": rows})
    print(results_table(rows))


if __name__ == "__main__":
    main()
