"""How well does a tokenizer's success classifier tell success in recorded frames, task by task?

    python -m experiments.steps.told outputs/tokenizer --dataset.root=outputs/rollouts --output=told.json

The frames are recorded ones, so no error of imagination counts. Each success is also shown with the
instruction of another task in the same dataset, drawn with a fixed seed: what was done is then not what is
asked for.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lerobot_wmrl.common.constants import START_TASK, TASK_NAMES
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.data.frame_cache import cached_features
from lerobot_wmrl.evaluation.gate import gate_at
from lerobot_wmrl.evaluation.outcomes import Outcomes, PredictedDone
from lerobot_wmrl.world_models.checkpoint import load_model


def outcomes_with(model: Any, table: EpisodeTable, instructions: Sequence[str]) -> Outcomes:
    """Judge the frames of all episodes, each with one of the instructions."""
    tokenizer = model.tokenizer
    features = cached_features(table.dataset, model.config.tokenizer.camera_keys, tokenizer)
    reader = tokenizer.success.instructions
    features.fill(slice(None))
    judged = []
    for episode, rows in enumerate(table.rows(range(len(table.start)))):
        seen = torch.from_numpy(np.array(features[rows]))
        with torch.no_grad():
            weights = None if reader is None else reader([instructions[episode]])
            probability = tokenizer.success.head(seen, weights).sigmoid()
        after = torch.cat([probability[1:], probability[-1:]])  # of the frame that each action leads to
        judged.append(PredictedDone(episode, after, table.done[rows]))
    return Outcomes.stack(judged)


def other_instructions(tasks: np.ndarray, instructions: Sequence[str]) -> list[str]:
    """Return for each episode the instruction of an episode of another task."""
    rng = np.random.default_rng(0)
    return [instructions[rng.choice(np.flatnonzero(tasks != task))] for task in tasks]


def told(model: Any, table: EpisodeTable, criterion: SuccessCriterion) -> dict[str, Any]:
    """Return the gate of each task on recorded frames, and how many of the successes that it tells also count
    under the instruction of another task."""
    tasks = table.column(START_TASK)
    own = outcomes_with(model, table, table.instructions)
    other = outcomes_with(model, table, other_instructions(tasks, table.instructions))
    found = {}
    for task in np.unique(tasks):
        of_task = tasks == task
        recognised = of_task & own.success & own.predicted_success(criterion)
        confused = recognised & other.predicted_success(criterion)
        found[TASK_NAMES[task]] = {
            **gate_at(own.where(of_task), criterion).as_json(),
            "under_another_instruction": Proportion(int(confused.sum()), int(recognised.sum())).as_json(),
        }
    return found


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tokenizer", help="frame tokenizer with a success classifier")
    parser.add_argument("--dataset.root", dest="root", required=True, help="rollouts of several tasks")
    parser.add_argument("--threshold", type=float, default=0.95, help="probability that counts as success")
    parser.add_argument("--frames", type=int, default=2, help="frames in a row that make a success")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    model = load_model(given.tokenizer, "frame_tokenizer", "cpu")
    criterion = SuccessCriterion(given.threshold, given.frames)
    write_json(given.output, told(model, read_episodes(open_dataset(given.root)), criterion))


if __name__ == "__main__":
    main()
